"""A recorded path held against an estimate: its error measured, compared with a prediction, made rows of a campaign."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.path_curve import STABILITY, Levels, fit_curve
from fpcal_bayes.fringes.reference import fit_fringe
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.traces import PathTrace, check_parts
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.interferometer import fringe, mirror_views
from fpcal_bayes.model.mechanics.errors import known_task_errors
from fpcal_bayes.model.trust import Trust

CheckVerdict = Literal["confirmed", "refuted", "not evaluated"]

#: Residuals this many times the noise of the reference scan: the curve does not follow the trace.
_LOST = 3.0
#: Below this sine of the starting phase a path starts too near an extreme.
_FLAT = 0.5
#: What measurement noise may add to the peak to peak of a check that confirms, in um.
_COARSE = 0.05
_DRAWS = 2000
#: Points along the path at which the estimate's own uncertainty is worked out.
_POINTS = 121
#: Of a row, in um: what no noise estimate goes below.
_LEAST_SIGMA = 1e-4


@dataclass(frozen=True, eq=False)
class PathError:
    """What a trace says of the error along its path."""

    at: Floats  # samples of the trace's path, as shares of it, shape (n,)
    error: Floats  # e, counted from the start of the path, in um, shape (n,)
    draws: Floats  # what noise and the uncertainty of A, B and phase may add to it, shape (n_draws, n_points)
    places: NDArray[np.int64]  # samples at which the draws stand, shape (n_points,)
    residual: float  # standard deviation of the irradiance around the curve, in V
    noise: float  # that of the reference scan
    amplitude: float  # of the fringes at the start, in V
    start_sine: float  # sine of the phase at the start: its size is 1 at half height, 0 at an extreme
    followed: bool  # whether the curve follows the trace
    #: Another error that fits as well, shape (n,), or None: near an extreme of the fringes the irradiance does not tell
    #: whether the cavity length went on or turned.
    rival: Floats | None = None

    @property
    def peak_to_peak(self) -> float:
        """Peak to peak of the error, in um."""
        return float(np.ptp(self.error[self.places]))

    @property
    def starts_flat(self) -> bool:
        """Whether it starts so near an extreme of the fringe that small changes hardly show."""
        return abs(self.start_sine) < _FLAT

    @property
    def peak_to_peak_sd(self) -> float:
        """Its standard deviation, in um."""
        return float(np.std(np.ptp(self.error[self.places] + self.draws, axis=1)))


@dataclass(frozen=True, eq=False)
class PathCheck:
    """A measured path error against the prediction of an estimate."""

    measured: PathError  # from the trace
    predicted: Floats  # peak to peak of the error by the estimate, one per draw, in um
    expected: Floats  # the same with measurement noise: what this trace should show if the calibration holds
    probability: float  # of at least the measured peak to peak, if the calibration holds
    #: ``refuted`` if that probability is below the level; ``not evaluated`` if the trace could not be followed, or is
    #: too uncertain to confirm what the estimate predicts (see `blunt`).
    verdict: CheckVerdict
    level: float  # see `verdict`
    trust: Trust = field(default_factory=Trust)  # of the estimate; nothing is evaluated against one not to be used

    @property
    def blunt(self) -> bool:
        """Whether measurement noise alone makes twice the error that is predicted, and 50 nm."""
        noisy, predicted = np.quantile(self.expected, 0.975), np.quantile(self.predicted, 0.975)
        return bool(noisy > max(2.0 * predicted, _COARSE))


def measure_path(
    estimate: Estimate, trace: PathTrace, *, index: float = 1.0, stability: float = STABILITY, seed: int = 0
) -> PathError:
    """The error along a path against an estimate, from its irradiance; arguments as in `check`."""
    check_parts(trace)
    cell, model = estimate.cell, CavityModel.of(estimate.cell, estimate.parameters)
    values, wavelength = estimate.values, cell.wavelength / index
    lengths, distance, tilt = mirror_views(model, values, trace.q)
    base = trace.before.start
    first = fit_fringe(lengths[trace.before] - lengths[base], trace.irradiance[trace.before], wavelength)
    last = None
    if trace.after.stop > trace.after.start:
        last = fit_fringe(lengths[trace.after] - lengths[trace.after.start], trace.irradiance[trace.after], wavelength)

    path = trace.path
    means, heights = fringe(cell.interferometer, distance, tilt)
    begin = float(trace.time_s[trace.before].mean())
    end = float(trace.time_s[trace.after].mean()) if last is not None else float(trace.time_s[-1])
    levels = Levels(
        first,
        last,
        (trace.time_s[path] - begin) / (end - begin),
        (means[path] - means[base]) / heights[base],
        heights[path] / heights[base],
        stability,
    )
    expected = first.wave_number * (lengths[path] - lengths[base])
    curve = fit_curve(trace.irradiance[path], expected, levels)

    n = path.stop - path.start
    places = np.unique(np.linspace(0, n - 1, min(n, _POINTS)).round().astype(np.int64))
    draws = curve.draws(np.random.default_rng(seed), _DRAWS, places)
    return PathError(
        at=np.linspace(0.0, 1.0, n),
        error=curve.error - curve.error[0],
        draws=draws - draws[:, :1],
        places=places,
        residual=curve.residual,
        noise=first.noise,
        amplitude=first.amplitude * float(levels.ratio[0]),
        start_sine=float(np.sin(expected[0] + first.phase)),
        rival=curve.rival,
        followed=curve.residual < _LOST * first.noise + 0.005 * first.amplitude,
    )


def check(
    estimate: Estimate,
    trace: PathTrace,
    *,
    draws: Floats | None = None,
    drift: Floats | None = None,
    index: float = 1.0,
    stability: float = STABILITY,
    level: float = 0.01,
    seed: int = 0,
) -> PathCheck:
    """Hold an estimate against a path that was recorded on the cell.

    Parameters
    ----------
    estimate
        What the path was made with. One that is not to be used gives the verdict ``not evaluated``.
    trace
        The recording, with its reference scans.
    draws
        Draws of the parameters from the posterior, shape (n_draws, n_free), in um and rad; by default the error is
        predicted to first order from the covariance.
    drift
        Covariance of what the parameters may have drifted since the estimate, shape (n_free, n_free).
    index
        Refractive index of the air.
    stability
        How gain and offset of the signal may bow between the reference scans, relative, one standard deviation.
    level
        Probability below which the calibration is refuted.
    seed
        The seed of numpy's default generator.

    Raises
    ------
    InputError
        If the recording lacks a part.
    """
    measured = measure_path(estimate, trace, index=index, stability=stability, seed=seed)
    model = CavityModel.of(estimate.cell, estimate.parameters, estimate.vector())
    q = trace.q[trace.path][measured.places]
    rows = model.rows(np.repeat(q[:1], len(q), axis=0), q)
    random = np.random.default_rng([seed, 1])
    _, jacobian = model.predict_with_jacobian(estimate.values, rows)

    def linear_errors(covariance: Floats) -> Floats:
        root = covariance_root(covariance, model.free.prior_sd)
        return np.asarray(random.standard_normal((_DRAWS, len(root))) @ (jacobian @ root).T)

    if estimate.mechanics is not None:
        errors = known_task_errors(estimate, q[0], q, draws=_DRAWS, seed=seed)[0].total
    elif draws is not None:
        errors = model.predict(draws, rows) - model.predict(estimate.values, rows)
        errors = errors[random.integers(len(errors), size=_DRAWS)]
    else:
        errors = linear_errors(estimate.covariance)
    if drift is not None:
        errors = errors + linear_errors(drift)
    predicted = np.ptp(errors, axis=1)
    expected = np.ptp(errors + measured.draws[random.permutation(len(measured.draws))], axis=1)
    # Never zero: so many draws tell no smaller probability.
    least = min(measured.peak_to_peak, np.inf if measured.rival is None else float(np.ptp(measured.rival)))
    probability = (1.0 + float((expected >= least).sum())) / (1.0 + len(expected))
    check = PathCheck(measured, predicted, expected, probability, "refuted", level, estimate.trust)
    if not measured.followed or not estimate.trust.usable:
        return replace(check, verdict="not evaluated")
    if probability < level:
        return check
    return replace(check, verdict="not evaluated" if check.blunt or measured.rival is not None else "confirmed")


def check_rows(
    estimate: Estimate, trace: PathTrace, measured: PathError, *, session: str, time_h: float, points: int = 0
) -> Sweeps:
    """A row of kind ``path``, unsigned peak to peak of the error, and sweeps to `points` points: a group, one start."""
    q, model = trace.q[trace.path], CavityModel.of(estimate.cell, estimate.parameters, estimate.vector())
    name = Path(trace.file).name or "path"
    # Without the start; the path's end too unless it is the start again.
    chosen = np.unique(np.linspace(0, len(measured.places) - 1, points + 2).round().astype(np.int64)[1:-1])
    starts, ends = np.repeat(q[:1], len(chosen) + 1, axis=0), np.vstack([q[-1:], q[measured.places[chosen]]])
    others = model.predict(estimate.values, model.rows(starts, ends))[1:] + measured.error[measured.places[chosen]]
    sd = float(measured.draws[:, chosen].std(axis=0).max(initial=0.0))
    first = np.arange(len(ends)) == 0
    return Sweeps.of_um_rad(
        starts,
        ends,
        session=session,
        label=["check", *(f"check-{i}" for i in range(1, len(ends)))],
        time_h=time_h,
        dl=[measured.peak_to_peak, *others],
        sigma=np.maximum(np.where(first, measured.peak_to_peak_sd, sd), _LEAST_SIGMA),
        signed=~first,
        kind=np.where(first, "path", "sweep"),
        trace=np.where(first, name, ""),
        group=np.where(first, "", "check"),
        file=name,
    )
