"""How the simulated rig moves and reads while it records."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RecorderSettings:
    """Motion, disturbances and noise of a recording; the defaults are those of a good laboratory.

    With the defaults the fastest of the paper's sweeps, 40 um along the optical axis, has 35 samples a fringe, all
    others more than 50.

    Attributes
    ----------
    duration_s
        Of the motion of a sweep or a path.
    rest_s
        For how long the photodiode is read before and after the motion of a sweep, at rest.
    rate_hz
        Samples a second, where `samples_per_fringe` is None.
    samples_per_fringe
        Samples of a fringe where the cavity length changes fastest, which then sets the rate: one number, or one a
        sweep, shape (n,). The robot is simulated, so the rig knows.
    fewest_samples
        Of a trace, where `samples_per_fringe` sets the rate.
    velocity_ripple, ripple_cycles
        Relative amplitude of a sine in the velocity and its periods in a recording, a whole number; its phase is drawn.
    envelope_change
        Peak to peak change of the signal's gain during a recording, about, relative: a ramp and a bow in drawn shares.
    offset_drift
        The same of a voltage added to the signal, relative to the trace's mean fringe amplitude.
    cyclic_error
        Second harmonic relative to the fringe amplitude, with a drawn phase.
    noise
        Standard deviation of a sample's voltage relative to the trace's mean fringe amplitude; None takes the volts
        that the cell states.
    length_noise
        Standard deviation of independent noise on the cavity length at each sample (vibration), in um.
    fading
        Whether visibility follows the mirror's distance and tilt along a trace; else it stays as at the trace's start.
    wavelength_error, wavelength_drift
        What the laser is off by, and its drift during a recording, in um; they multiply L, so 1 pm does as 0.6 nm of L.
    temperature_c, pressure_hpa, humidity_pct
        Of the air, recorded with the data; NaN: unknown, index 1.
    scan_from, scan_to, scan_samples
        Ends of a wavelength scan in um and its samples.
    reference_fringes
        Fringes that the reference scans before and after a path span.
    quadrature
        Whether a path starts from the nearest point at half fringe height, to which the reference joint is moved.
    """

    duration_s: float = 10.0
    rest_s: float = 0.0
    rate_hz: float = 200.0
    samples_per_fringe: float | Floats | None = None
    fewest_samples: int = 40
    velocity_ripple: float = 0.1
    ripple_cycles: int = 7
    envelope_change: float = 0.01
    offset_drift: float = 0.005
    cyclic_error: float = 0.0
    noise: float | None = None
    length_noise: float = 0.0
    fading: bool = True
    wavelength_error: float = 0.0
    wavelength_drift: float = 0.0
    temperature_c: float = float("nan")
    pressure_hpa: float = float("nan")
    humidity_pct: float = float("nan")
    scan_from: float = 1.520
    scan_to: float = 1.600
    scan_samples: int = 1601
    reference_fringes: float = 3.0
    quadrature: bool = True

    def __post_init__(self) -> None:
        positive = ("duration_s", "rate_hz", "fewest_samples", "scan_from", "scan_to", "reference_fringes")
        for name in positive:
            self._require(name, getattr(self, name) > 0, "a number above zero")
        for name in ("rest_s", "envelope_change", "offset_drift", "cyclic_error", "length_noise"):
            self._require(name, getattr(self, name) >= 0, "zero or more")
        self._require("velocity_ripple", 0 <= self.velocity_ripple < 1, "0 to below 1: the joint must not turn back")
        self._require("ripple_cycles", int(self.ripple_cycles) == self.ripple_cycles > 0, "a whole number above zero")
        self._require("noise", self.noise is None or self.noise >= 0, "zero or more")
        self._require("scan_samples", self.scan_samples >= 2, "two or more")
        if self.samples_per_fringe is not None:
            self._require("samples_per_fringe", bool((np.asarray(self.samples_per_fringe) > 0).all()), "above zero")

    def _require(self, name: str, good: bool, expected: str) -> None:
        if not good:
            raise InputError(f"recorder: {name} = {getattr(self, name)}: expected {expected}")


#: A poor day: gain, offset, second harmonic and noise relative to the fringes.
HARD = RecorderSettings(envelope_change=0.2, offset_drift=0.1, cyclic_error=0.01, noise=0.01)
