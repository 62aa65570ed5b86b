"""The numbers that are shown of recorded light: a path that checks a calibration, and a sweep that was read."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.count import Reading
from fpcal_bayes.fringes.path_check import PathCheck, starts_flat
from fpcal_bayes.fringes.profile import lengths_at
from fpcal_bayes.fringes.samples import Samples


@dataclass(frozen=True)
class CheckNumbers:
    """What is shown of a checked path beside its own numbers: lengths in nm."""

    predicted: tuple[float, float, float]  # of the peak to peak by the estimate: lower edge of its band, median, upper
    noisy: float  # upper edge of the same with the noise of the recording
    rival: float | None  # peak to peak of another error that fits as well
    height: float | None  # percent of the way to a fringe's extreme at the start, where that is too near
    within: float | None  # probability, by the measurement alone, that the peak to peak is within the tolerance

    @classmethod
    def of(cls, check: PathCheck, tolerance: float | None = None) -> "CheckNumbers":
        """Numbers of a check, with a tolerance in um."""
        measured, (low, high) = check.measured, check.predicted_band()
        sizes = np.ptp(measured.error[measured.places] + measured.draws, axis=1)
        return cls(
            predicted=(1e3 * low, 1e3 * float(np.median(check.predicted)), 1e3 * high),
            noisy=1e3 * float(np.quantile(check.expected, 0.975)),
            rival=None if measured.rival is None else 1e3 * float(np.ptp(measured.rival)),
            height=50.0 * (1.0 + np.sqrt(1.0 - measured.start_sine**2)) if starts_flat(measured) else None,
            within=None if tolerance is None else float((sizes <= tolerance).mean()),
        )


#: Points of a fitted curve.
_CURVE = 4000


@dataclass(frozen=True)
class FittedSweep:
    """The curve that was fitted to the trace of a sweep."""

    s: Floats  # (n,), from -1 at the start of the sweep to 1 at its end
    signal: Floats  # (n,), V
    lengths: Floats  # (n,), L less L at the start, um
    tops: Ints  # places on the curve at which a fringe was found
    residual: Floats  # (n_samples,), V
    noise: float  # V

    @classmethod
    def of(cls, reading: Reading, samples: Samples) -> "FittedSweep | None":
        """The fitted curve of a reading and its trace; None where the trace was refused."""
        fit, phase_per_um = reading.fit, reading.phase_per_um
        if fit is None:
            return None
        s = np.linspace(-1.0, 1.0, _CURVE)
        order = np.argsort(samples.s, kind="stable")
        time = np.interp(s, samples.s[order], samples.time[order])
        lengths = lengths_at(reading.profile if len(reading.profile) else fit.profile, s)
        turned = fit.phase(s, phase_per_um) / (2.0 * np.pi)
        return cls(
            s=s,
            signal=fit.signal(s, time, phase_per_um),
            lengths=lengths - lengths[0],
            tops=np.flatnonzero(np.diff(np.floor(turned)) != 0),
            residual=samples.signal - fit.signal(samples.s, samples.time, phase_per_um),
            noise=fit.noise,
        )
