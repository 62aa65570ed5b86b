"""Sizes of the drift from a history of sessions, by maximum likelihood through the filter.

A few epochs say little: intervals come from the profile of the likelihood, which shows it. Where even no drift at all
fits, the lower end is zero; where any size fits, the upper end is infinite.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, special

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.drift_sizes import DriftSize
from fpcal_bayes.tracking.drift import DriftModel, likely_drift
from fpcal_bayes.tracking.filter import predict, update
from fpcal_bayes.tracking.measurement import SweepMeasurement
from fpcal_bayes.tracking.sessions import check_sessions, mean_temperature
from fpcal_bayes.tracking.tracker import Track, calibrate

#: Factors by which sizes are tried around their starting values.
REACH = (1e-2, 1e2)
#: Confidence level of the intervals.
LEVEL = 0.95


@dataclass(frozen=True)
class FittedFactor:
    """A factor on the random walks of some parameters, and the ends of its profile-likelihood interval.

    1 leaves the starting sizes; the ends are 0 and infinity where the likelihood does not end the interval.
    """

    names: tuple[str, ...]
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class FittedSizes:
    """Result of `fit_sizes`."""

    stated: DriftModel
    drift: DriftModel  # with the fitted sizes
    factors: tuple[FittedFactor, ...]  # one a group of parameters
    log_likelihood: float

    def content(self) -> dict[str, Any]:
        """What ``track --json`` writes under ``drift_fit``; walks after one day in the units a person reads."""
        return {
            "level": LEVEL,
            "log_likelihood": self.log_likelihood,
            "groups": [
                {
                    "parameters": list(factor.names),
                    "factor": factor.value,
                    "low": factor.low,
                    "high": factor.high if np.isfinite(factor.high) else None,
                }
                for factor in self.factors
            ],
            "walks": {
                name: {"unit": unit, "cell": stated, "fitted": factor.value * stated}
                for factor, name, unit, stated in self._walks()
            },
        }

    def lines(self) -> list[str]:
        """The sizes beside those of the cell, in words."""
        lines = [f"random walks after one day that these sessions support, with {LEVEL:.0%} intervals:"]
        for factor, name, unit, stated in self._walks():
            fitted, low, high = (f"{stated * size:.2g}" for size in (factor.value, factor.low, factor.high))
            lines.append(f"  {name} {fitted} {unit} ({low} to {high}); the cell states {stated:.2g}")
        return lines

    def _walks(self) -> list[tuple[FittedFactor, str, str, float]]:
        """Factor, name, unit and stated walk in that unit of each parameter that drifts."""
        sizes = {size.name: size.walk for size in self.stated.sizes}
        found = []
        for factor in self.factors:
            for name in factor.names:
                if sizes[name] > 0:
                    parameter = self.stated.parameters[name]
                    found.append((factor, name, parameter.unit, float(parameter.shown(sizes[name]))))
        return found


def fit_sizes(cell: Cell, sweeps: Sweeps, groups: Sequence[Sequence[str]] | None = None) -> FittedSizes:
    """Fit factors on the random walks of groups of parameters to a campaign; `InputError` where it cannot tell them.

    Parameters
    ----------
    cell
        Its drift sizes are the starting values (see `likely_drift`).
    sweeps
        Sweeps of all sessions; the first is the calibration. Rows without sign are left out.
    groups
        Names of the parameters that share a factor; by default those that drift of mirror and fibre, and of the robot.
    """
    drift = likely_drift(cell, sweeps)
    groups = _parts(drift) if groups is None else groups
    parts = check_sessions(sweeps)
    if len(parts) < 2:
        raise InputError(f"{sweeps.file}: expected sessions after the calibration to learn drift from")
    for group in groups:
        if not (drift.walk[drift.parameters.positions(group)] > 0).any():
            raise InputError(f"none of {', '.join(group)} drifts in cell {cell.name!r}: expected a starting size")
    begun = calibrate(cell, drift, parts[0])[0]
    drift, first = replace(drift, motions=begun.motions), begun.state
    model = CavityModel.of(cell, drift.parameters)

    def log_likelihood(log_factors: Floats) -> float:
        sized = _resized(drift, groups, np.exp(log_factors))
        state, total = first, 0.0
        for part in parts[1:]:
            used = part.take((part.kind != "path") & (part.signed | part.absolute))
            state = predict(sized, state, float(part.time_h.max()), mean_temperature(part))
            if len(used):
                taken = update(state, SweepMeasurement.of(sized, model, used, state.mean))
                state, total = taken.state, total + taken.innovation.log_likelihood
        return total

    best, top = maximise(log_likelihood, len(groups))
    factors = []
    for i, group in enumerate(groups):
        low, high = profile_interval(log_likelihood, best, top, i, LEVEL)
        factors.append(FittedFactor(tuple(group), float(np.exp(best[i])), low, high))
    return FittedSizes(drift, _resized(drift, groups, np.exp(best)), tuple(factors), top)


def _parts(drift: DriftModel) -> list[list[str]]:
    """The parameters that drift: those of the robot, and those of mirror and fibre."""
    names = np.array(drift.parameters.names)
    parts = [names[(drift.walk > 0) & (drift.extrinsic == which)].tolist() for which in (False, True)]
    return [part for part in parts if part]


def maximise(log_likelihood: Callable[[Floats], float], count: int) -> tuple[Floats, float]:
    """Maximum of a log likelihood of `count` log factors within `REACH`, from factors of one."""
    found = _maximum(log_likelihood, np.zeros(count))
    return found, log_likelihood(found)


def profile_interval(
    log_likelihood: Callable[[Floats], float], best: Floats, top: float, which: int, level: float
) -> tuple[float, float]:
    """Ends of the interval of one factor, the others following (likelihood ratio: chi-square, one degree of freedom).

    They are 0 or infinity where the likelihood does not fall by enough within `REACH`.
    """
    drop = 0.5 * float(special.chdtri(1, 1.0 - level))

    def excess(log_factor: float) -> float:
        others = np.delete(best, which)
        if len(others):
            others = _maximum(lambda rest: log_likelihood(np.insert(rest, which, log_factor)), others, coarse=True)
        return top - log_likelihood(np.insert(others, which, log_factor)) - drop

    ends = []
    for edge, beyond in zip(np.log(REACH), (0.0, np.inf), strict=True):
        if excess(float(edge)) < 0:
            ends.append(float(beyond))
        else:
            inner, outer = sorted((float(best[which]), float(edge)))
            ends.append(float(np.exp(optimize.brentq(excess, inner, outer, xtol=1e-2))))
    return ends[0], ends[1]


def _maximum(log_likelihood: Callable[[Floats], float], start: Floats, *, coarse: bool = False) -> Floats:
    """Maximum from a starting point (count,), within `REACH`."""
    low, high = np.log(REACH)
    # A first simplex of factors of two: the default one is too small around zero.
    inward = np.where(start > 0.0, -np.log(2.0), np.log(2.0))
    simplex = np.vstack([start, start + np.diag(inward)])
    options: dict[str, Any] = {"xatol": 1e-2, "fatol": 1e-3, "initial_simplex": simplex}
    if coarse:
        # On a profile the others need only be near their maximum, where the likelihood is flat.
        options |= {"xatol": 0.1, "fatol": 1e-2}
    found = optimize.minimize(  # type: ignore[call-overload]
        lambda x: -log_likelihood(np.clip(x, low, high)), start, method="Nelder-Mead", options=options
    )
    result: Floats = np.clip(found.x, low, high)
    return result


def _resized(drift: DriftModel, groups: Sequence[Sequence[str]], factors: Floats) -> DriftModel:
    by_name = {name: float(factor) for group, factor in zip(groups, factors, strict=True) for name in group}

    def change(size: DriftSize) -> DriftSize:
        return replace(size, walk=size.walk * by_name.get(size.name, 1.0))

    return drift.resized(change)


#: Scales of all drifts that are tried where innovations contradict those stated, and the prior of their logarithm.
_SCALE_SD = float(np.log(3.0))
_SCALES = _SCALE_SD * np.linspace(-2.0, 2.0, 7)
#: Innovations so unlikely that the scale is learnt; a scale within this of one is not worth a word.
_CONTRADICTED, _WORTH_SAYING = 0.01, float(np.log(1.5))
#: A session is a step, a knock or a slip with this probability; its innovation is then so many times as wide.
_STEP, _STEP_WIDTH = 0.05, 30.0


#: Last sessions that tell the pace: more cost time, and say how the cell drifted long ago.
_LEARNT_FROM = 8


def with_learnt_scale(found: Track, follow: Callable[[DriftModel, Track], Track]) -> Track:
    """The track with the drift as fast as its innovations say, one scale of robot and one of mirror and fibre.

    `follow` takes in the sessions after a track of the first one under other sizes. The scales have a log-normal prior
    around one, a factor of three wide; what stands for them is the root of the mean square of their posterior.
    """
    later = [outcome for outcome in found.outcomes[1:] if outcome.dof]
    nis, dof = (np.array([getattr(o, name) for o in later], dtype=float) for name in ("nis", "dof"))
    # A third of the sessions may hold a step, which says nothing of the pace.
    calm: Ints = np.argsort(nis / dof, kind="stable")[: len(later) - -(-len(later) // 3)]
    fast = chi2_tail(float(nis[calm].sum()), float(dof[calm].sum())) if len(calm) else 1.0
    slow = float(special.gammainc(dof.sum() / 2.0, nis.sum() / 2.0)) if len(later) > 1 else 1.0
    groups = _parts(found.drift)
    if min(fast, slow) > _CONTRADICTED or not groups:
        return found
    begun = replace(found, outcomes=found.outcomes[: max(1, len(found.outcomes) - _LEARNT_FROM)])
    log = np.zeros(len(groups))
    for which in (np.ones(len(groups), dtype=bool), *np.eye(len(groups), dtype=bool)[: len(groups) - 1]):
        trials = [np.where(which, centre, log) for centre in _SCALES]
        tracks = [follow(_resized(found.drift, groups, np.exp(trial)), begun) for trial in trials]
        weights = special.softmax(
            [_calmly(t) - 0.5 * (c / _SCALE_SD) ** 2 for t, c in zip(tracks, _SCALES, strict=True)]
        )
        log = np.where(which, 0.5 * np.log(weights @ np.exp(2.0 * _SCALES)), log)
    learnt = follow(_resized(found.drift, groups, np.exp(log)), begun)
    told = [(np.exp(each), group) for each, group in zip(log, groups, strict=True) if abs(each) > _WORTH_SAYING]
    said = "; ".join(f"{', '.join(group)}: {scale:.2g} times" for scale, group in told)
    pace = "faster" if log.sum() > 0 else "slower"
    # Sizes that blame the robot where the stated ones do not are no better than these.
    blames = found.trust.usable and not learnt.trust.usable
    taken = "forecasts keep the stated sizes" if blames else "forecasts take it so"
    note = f"drift {pace} than stated ({said}): {taken}; fpcal track --fit-drift gives sizes for the cell"
    if blames:
        return replace(found, pace=note if told else None)
    return replace(learnt, resumed=found.resumed, stated=found, pace=note if told else None)


def _calmly(track: Track) -> float:
    """Log likelihood of the sessions after the first, each a step with a small probability."""
    total = 0.0
    for outcome in track.outcomes[1:]:
        wide = outcome.log_likelihood + 0.5 * outcome.nis * (1.0 - _STEP_WIDTH**-2) - outcome.dof * np.log(_STEP_WIDTH)
        total += float(np.logaddexp(np.log1p(-_STEP) + outcome.log_likelihood, np.log(_STEP) + wide))
    return total
