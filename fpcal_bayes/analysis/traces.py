"""The numbers that are shown of recorded light: a path that checks a calibration, and a sweep that was read."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.count import Reading
from fpcal_bayes.fringes.path_check import PathCheck, starts_flat
from fpcal_bayes.fringes.profile import legendre
from fpcal_bayes.fringes.samples import Samples


@dataclass(frozen=True)
class CheckNumbers:
    """A checked path: lengths in nm, bands that hold 95 %."""

    peak_to_peak: float  # of what was measured
    peak_to_peak_sd: float
    median: float  # of the peak to peak that the estimate predicts
    low: float
    high: float
    noisy: float  # upper edge of the same with the noise of the recording
    rival: float | None  # peak to peak of another error that fits as well
    least_probability: float  # that so many draws can tell
    height: float | None  # percent of the way to a fringe's extreme at the start, where that is too near
    along: Floats  # (n_points,), shares of the path
    error: Floats  # (n_points,)
    error_sd: Floats  # (n_points,)
    tolerance: float | None
    within: float | None  # probability, by the measurement alone, that the peak to peak is within the tolerance

    @classmethod
    def of(cls, check: PathCheck, tolerance: float | None = None) -> "CheckNumbers":
        """Of a check, with the probability that the path is within `tolerance` in um."""
        measured, (low, high) = check.measured, check.predicted_band()
        within = None
        if tolerance is not None:
            sizes = np.ptp(measured.error[measured.places] + measured.draws, axis=1)
            within = float((sizes <= tolerance).mean())
        height = 50.0 * (1.0 + np.sqrt(1.0 - measured.start_sine**2)) if starts_flat(measured) else None
        return cls(
            peak_to_peak=1e3 * measured.peak_to_peak,
            peak_to_peak_sd=1e3 * measured.peak_to_peak_sd,
            median=1e3 * float(np.median(check.predicted)),
            low=1e3 * low,
            high=1e3 * high,
            noisy=1e3 * float(np.quantile(check.expected, 0.975)),
            rival=None if measured.rival is None else 1e3 * float(np.ptp(measured.rival)),
            least_probability=1.0 / (1.0 + len(check.expected)),
            height=height,
            along=measured.at[measured.places],
            error=1e3 * measured.error[measured.places],
            error_sd=1e3 * measured.draws.std(axis=0),
            tolerance=None if tolerance is None else 1e3 * tolerance,
            within=within,
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
        """Of a reading and its trace; None where the trace was refused."""
        fit, phase_per_um = reading.fit, reading.phase_per_um
        if fit is None:
            return None
        s = np.linspace(-1.0, 1.0, _CURVE)
        order = np.argsort(samples.s, kind="stable")
        time = np.interp(s, samples.s[order], samples.time[order])
        lengths = legendre(s)[:, 1:] @ (reading.course if len(reading.course) else fit.course)
        turned = fit.phase(s, phase_per_um) / (2.0 * np.pi)
        return cls(
            s=s,
            signal=fit.signal(s, time, phase_per_um),
            lengths=lengths - lengths[0],
            tops=np.flatnonzero(np.diff(np.floor(turned)) != 0),
            residual=samples.signal - fit.signal(samples.s, samples.time, phase_per_um),
            noise=fit.noise,
        )
