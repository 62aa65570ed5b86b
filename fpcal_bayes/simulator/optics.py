"""The simulated rig: how it moves and what disturbs it, and the voltages that its photodiode then shows."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.traces import WavelengthScan
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.air_index import air_index
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.interferometer import fringe, mirror_views, read_out, reflected
from fpcal_bayes.simulator.machine import Machine

#: Points at which the speed of a sweep is looked at before it is recorded.
_COARSE = 257
#: Periods of the ripple of the velocity in a recording.
_RIPPLE_CYCLES = 7
#: Ends of a wavelength scan in um, and its samples.
_SCAN = (1.520, 1.600, 1601)


@dataclass(frozen=True)
class RecorderSettings:
    """Motion, disturbances and noise of a recording; the defaults are those of a good laboratory.

    With them the fastest of the paper's sweeps has 35 samples a fringe, all others more than 50.
    """

    duration_s: float = 10.0  # of the motion of a sweep or a path
    rest_s: float = 0.0  # for how long the photodiode is read before and after the motion of a sweep, at rest
    rate_hz: float = 200.0  # samples a second, where `samples_per_fringe` is None
    #: Samples of a fringe where the cavity length changes fastest, which then sets the rate: one number, or one a
    #: sweep, shape (n,). The robot is simulated, so the rig knows.
    samples_per_fringe: float | Floats | None = None
    fewest_samples: int = 40  # of a trace, where `samples_per_fringe` sets the rate
    velocity_ripple: float = 0.1  # relative amplitude of a sine in the velocity, of drawn phase
    #: Peak to peak change of the signal's gain during a recording, about, relative: a ramp and a bow in drawn shares.
    envelope_change: float = 0.01
    offset_drift: float = 0.005  # the same of a voltage added, relative to the trace's mean fringe amplitude
    cyclic_error: float = 0.0  # second harmonic relative to the fringe amplitude, with a drawn phase
    noise: float | None = None  # sd of a sample, relative to the trace's mean fringe amplitude; None: the cell's volts
    fading: bool = True  # whether visibility follows distance and tilt along a trace; else it stays as at its start
    wavelength_error: float = 0.0  # what the laser is off by, in um; it multiplies L, so 1 pm does as 0.6 nm of L
    wavelength_drift: float = 0.0  # how it drifts during a recording, in um
    temperature_c: float = float("nan")  # of the air like the next two, recorded with the data; NaN: unknown, index 1
    pressure_hpa: float = float("nan")
    humidity_pct: float = float("nan")
    quadrature: bool = True  # whether the reference joint moves to half fringe height, nearby, before a path starts

    def __post_init__(self) -> None:
        for name in ("duration_s", "rate_hz", "fewest_samples", "samples_per_fringe"):
            stated = getattr(self, name)
            if stated is not None and not np.all(np.asarray(stated) > 0):
                raise InputError(f"recorder: {name} = {stated}: expected a number above zero")
        for name in ("rest_s", "envelope_change", "offset_drift", "cyclic_error", "noise"):
            if (getattr(self, name) or 0.0) < 0:
                raise InputError(f"recorder: {name} = {getattr(self, name)}: expected zero or more")
        if not 0 <= self.velocity_ripple < 1:
            what = "expected 0 to below 1: the joint must not turn back"
            raise InputError(f"recorder: velocity_ripple = {self.velocity_ripple}: {what}")


#: How joints have reached poses: own-axis errors (n, n_joints) in um and rad, without the encoders' part, and
#: minutes of the session (n,).
Reached = tuple[Floats, Floats]
#: Cavity length, perpendicular distance and tilt along a recording, each of shape (n,).
Views = tuple[Floats, Floats, Floats]


@dataclass(frozen=True)
class Chances:
    """What is drawn for one recording: phases and shapes of its disturbances, and the stream of its noise."""

    random: np.random.Generator  # stream of the noise
    ripple: float  # phases in rad, from here to `cyclic`
    envelope: float
    offset: float
    cyclic: float
    start: Floats  # standard normals for the joints' repeatability at the start, shape (n_joints,)
    end: Floats  # likewise at the end

    @classmethod
    def several(cls, seed: int, n: int, n_joints: int) -> list["Chances"]:
        """One for each of `n` recordings, from a stream of its own; `InputError` if the seed is negative."""
        if seed < 0:
            raise InputError(f"seed {seed}: expected a whole number, zero or more")
        made = []
        for stream in np.random.SeedSequence(seed).spawn(n):
            random = np.random.default_rng(stream)
            phases = random.uniform(0.0, 2.0 * np.pi, 4).tolist()
            made.append(cls(random, *phases, *random.standard_normal((2, n_joints))))
        return made


@dataclass(frozen=True)
class SimulatedOptics:
    """A cell with a truth, recorded with some settings."""

    cell: Cell
    truth: Truth
    settings: RecorderSettings
    machine: Machine | None = None  # whose error motions are recorded; None on a perfect mechanism

    @cached_property
    def model(self) -> CavityModel:
        """Cavity model whose free parameters the truth holds."""
        return CavityModel.of(self.cell, self.truth.parameters)

    @cached_property
    def index(self) -> float:
        """Refractive index of the air at the cell's wavelength."""
        s = self.settings
        return float(air_index(self.cell.wavelength, s.temperature_c, s.pressure_hpa, s.humidity_pct))

    def views(self, q: Floats, time_h: Floats, of: Ints, reached: Reached | None = None) -> Views:
        """How the mirror stands at joints `q` (n, n_joints), which a machine has `reached`, at time ``time_h[of]``."""
        result = np.empty((3, len(q)))
        times, epoch = np.unique(np.clip(time_h, self.truth.times_h[0], self.truth.times_h[-1]), return_inverse=True)
        for i, values in enumerate(self.truth.at(times)):
            now = (epoch == i)[of]
            result[:, now] = mirror_views(self.model, values, q[now])
            if self.machine is not None and reached is not None:
                machine = replace(self.machine, vector=self.model.vector(values))
                errors = reached[0][now] + machine.periodic(q[now])
                result[0, now] = np.copysign(machine.lengths(q[now], errors, reached[1][now]), result[0, now])
        return result[0], result[1], result[2]

    def counts(self, q_start: Floats, q_end: Floats, time_h: Floats) -> Ints:
        """Samples of each sweep's motion, shape (n,)."""
        n, s = len(q_start), self.settings
        if s.samples_per_fringe is None:
            return np.full(n, max(s.fewest_samples, round(s.rate_hz * s.duration_s) + 1), dtype=np.int64)
        coarse = q_start[:, None] + (q_end - q_start)[:, None] * np.linspace(0.0, 1.0, _COARSE)[:, None]
        of = np.repeat(np.arange(n), _COARSE)
        lengths = self.views(coarse.reshape(-1, q_start.shape[1]), time_h, of)[0].reshape(n, _COARSE)
        fastest = np.abs(np.diff(lengths, axis=1)).max(axis=1) * (_COARSE - 1) * (1.0 + s.velocity_ripple)
        wanted = np.ceil(np.asarray(s.samples_per_fringe) * fastest / (self.cell.wavelength / 2.0)).astype(np.int64) + 1
        return np.maximum(wanted, s.fewest_samples)

    def progress(self, n: int, ripple: float) -> Floats:
        """Share of a sweep that is done at each of its `n` samples and those at rest; `ripple` is a phase."""
        if n == 0:
            return np.zeros(0)
        time, s = np.linspace(0.0, 1.0, n), self.settings
        turn = 2.0 * np.pi * _RIPPLE_CYCLES
        done: Floats = time + s.velocity_ripple / turn * (np.sin(turn * time + ripple) - np.sin(ripple))
        done[-1] = 1.0
        rest = round(s.rest_s / s.duration_s * (n - 1))
        return np.concatenate([np.zeros(rest), done, np.ones(rest)])

    def voltages(self, seen: Views, chances: Chances, at: Floats | None = None) -> Floats:
        """What is recorded along a trace at shares `at` of its time (n,), by default equal steps."""
        s, optics = self.settings, self.cell.interferometer
        length, distance, tilt = seen
        time = np.linspace(0.0, 1.0, len(length)) if at is None else at
        if not s.fading:
            distance, tilt = distance[:1], tilt[:1]
        light = optics.wavelength + s.wavelength_error + s.wavelength_drift * time
        share = reflected(optics, length, distance, tilt, wavelength=light, index=self.index)
        amplitude = fringe(optics, distance, tilt)[1]
        if s.cyclic_error > 0:
            phase = 4.0 * np.pi * self.index * length / light
            share = share + s.cyclic_error * amplitude * np.cos(2.0 * phase + chances.cyclic)
        height = optics.gain * float(np.mean(amplitude))
        signal = optics.gain * share * (1.0 + s.envelope_change * _shape(time, chances.envelope))
        signal = signal + optics.dark + height * s.offset_drift * _shape(time, chances.offset)
        noise = optics.noise if s.noise is None else s.noise * height
        return read_out(optics, signal + noise * chances.random.standard_normal(len(signal)))

    def scan(self, q: Floats, time_h: float, chances: Chances, reached: Reached | None = None) -> WavelengthScan:
        """A wavelength scan at rest at one joint vector (n_joints,)."""
        s, optics = self.settings, self.cell.interferometer
        told = np.linspace(*_SCAN)
        length, distance, tilt = self.views(q[None], np.array([time_h]), np.zeros(1, dtype=np.int64), reached)
        share = reflected(optics, length, distance, tilt, wavelength=told + s.wavelength_error, index=self.index)
        height = optics.gain * float(fringe(optics, distance, tilt)[1][0])
        noise = optics.noise if s.noise is None else s.noise * height
        signal = optics.gain * share + optics.dark + noise * chances.random.standard_normal(len(told))
        return WavelengthScan(told, read_out(optics, signal))


def _shape(time: Floats, phase: float) -> Floats:
    """A ramp and a bow, mixed by a phase: about zero, about one from peak to peak."""
    ramp, bow = time - 0.5, 4.0 * time * (1.0 - time) - 0.5
    return np.asarray(np.cos(phase) * ramp + np.sin(phase) * bow)
