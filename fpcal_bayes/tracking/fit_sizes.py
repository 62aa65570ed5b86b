"""How fast a cell drifts, as the innovations of its sessions say: one factor of the robot, one of mirror and fibre.

The likelihood of both factors is that of a filter whose rows are linearised where the sessions led, worked out for a
whole grid of factors at once. A session counts as a step, a knock or a slip with a small probability, so that one jump
is no pace. `with_learnt_pace` learns the factors where sessions contradict the stated sizes; `fit_sizes` says which
sizes a history supports. A few epochs say little, and the intervals from the profile of the likelihood show it: where
even no drift at all fits, the lower end is zero; where any size fits, the upper end is infinite.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import interpolate, special

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.corrections import with_signs
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.filter import kelvin_between
from fpcal_bayes.tracking.measurement import SweepMeasurement, equivalent_rows
from fpcal_bayes.tracking.session import followed_drift
from fpcal_bayes.tracking.sessions import mean_temperature
from fpcal_bayes.tracking.tracker import Track

#: Factors that a history is held to, and the confidence level of their intervals.
_FITTED = np.linspace(np.log(1e-2), np.log(1e2), 41)
LEVEL = 0.95
#: Factors that are tried where sessions contradict the stated sizes, and the prior of their logarithm.
_PACE_SD = float(np.log(3.0))
_PACES = _PACE_SD * np.linspace(-2.0, 2.0, 13)
#: How much likelier than the stated sizes other paces must be together: looked at after every session, the right sizes
#: are then left in one campaign of twenty at most (Ville's inequality).
_CONTRADICTED = float(np.log(20.0))
#: A change of the pace that is worth taking the sessions in again.
_CHANGED = float(np.log(1.1))
#: A session is a step with this probability, half of it of one parameter alone.
_STEP = 0.05
#: The pace is that of the last sessions, of about so many rows and at most so many sessions, which are judged anew.
_LEARNT_ROWS, _LEARNT_SESSIONS = 48, 64


def _log_likelihood(found: Track, parts: list[Sweeps], first: int, paces: Floats) -> Floats:
    """Log likelihood of the sessions after `first` under each of some paces (n_paces, 2), shape (n_paces,)."""
    drift, outcomes = found.drift, found.outcomes
    model, n, step = CavityModel.of(found.cell, drift.parameters), drift.n_parameters, np.zeros(drift.n_states)
    step[:n] = Limits().jump(drift) ** 2
    # What a session may be: calm, a jump of all parameters, of each alone.
    jumps = np.vstack([np.zeros_like(step), step, np.diag(step)[:n]])
    odds = np.log([1.0 - _STEP, 0.5 * _STEP, *[0.5 * _STEP / n] * n])
    # What moves a state is linear in the squares of the paces, and of the parameters alone.
    drifts = [followed_drift(replace(drift, pace=pace), model, outcomes[0]) for pace in ((0, 0), (1, 0), (0, 1))]
    total, diagonal = np.zeros(len(paces)), np.arange(drift.n_states)
    mean = np.tile(outcomes[first].state.mean, (len(paces), 1))
    spread = np.tile(outcomes[first].state.covariance, (len(paces), 1, 1))
    for (before, now), part in zip(pairwise(outcomes[first:]), parts[first + 1 :], strict=False):
        kelvin = kelvin_between(before.state.temperature_c, mean_temperature(part))
        still, robot, mirror = (each.transition(now.time_h - before.time_h, kelvin) for each in drifts)
        noise = np.tensordot(paces**2, [(each.noise - still.noise)[:n, :n] for each in (robot, mirror)], 1)
        mean, moved = mean @ still.matrix.T + still.shift, (still.matrix != np.eye(drift.n_states)).any()
        if moved:
            spread = still.matrix @ spread @ still.matrix.T + still.noise
        spread[:, :n, :n] += noise
        used, _ = with_signs(drift, model, now.predicted, part.take(part.kind != "path"))
        if not len(used) or not now.converged:
            continue
        at = now.state.mean
        misfit, jacobian = SweepMeasurement.of(drift, model, used, at).linearise(at)
        rows, seen = equivalent_rows(misfit + jacobian @ at, jacobian)
        left = rows - mean @ seen.T
        cross = seen @ spread
        expected = cross @ seen.T + np.eye(len(seen))
        likely = np.empty((len(paces), n + 2))
        for column, covariance in ((1, expected + (seen * step) @ seen.T), (0, expected)):
            weighed = np.linalg.solve(covariance, left[..., None])[..., 0]
            likely[:, column] = -0.5 * ((left * weighed).sum(axis=1) + np.linalg.slogdet(covariance)[1])
        size = step * (seen * np.linalg.solve(expected, seen)).sum(axis=1)
        alone = 0.5 * (step * (weighed @ seen) ** 2 / (1.0 + size) - np.log1p(size))
        likely[:, 2:] = likely[:, :1] + alone[:, :n]
        total += special.logsumexp(odds + likely, axis=1)
        jumped = jumps[(odds + likely).argmax(axis=1)]
        spread[:, diagonal, diagonal] += jumped
        cross += seen * jumped[:, None]
        gain = np.linalg.solve(cross @ seen.T + np.eye(len(seen)), cross)
        mean = mean + np.einsum("gij,gi->gj", gain, left)
        spread -= np.swapaxes(cross, 1, 2) @ gain
    return total


def with_learnt_pace(found: Track, parts: list[Sweeps], follow: Callable[[Track], Track]) -> Track:
    """The track with the pace that its last sessions show, taken in again, where they contradict the stated sizes."""
    count, drifts = len(found.outcomes), [len(part) > 0 for part in found.drift.drifting]
    if count == 1 or not any(drifts):
        return found
    rows = np.cumsum([outcome.n_sweeps for outcome in found.outcomes[:0:-1]])
    used = min(int(np.searchsorted(rows, _LEARNT_ROWS)) + 1, _LEARNT_SESSIONS, count - 1)
    grid = np.stack(np.meshgrid(_PACES, _PACES, indexing="ij"), axis=-1).reshape(-1, 2)
    prior = special.log_softmax(-0.5 * ((grid / _PACE_SD) ** 2).sum(axis=1))
    likely = _log_likelihood(found, parts, count - 1 - used, np.exp(grid))
    together = special.logsumexp(prior + likely)
    if found.drift.pace == (1.0, 1.0) and together - likely[len(grid) // 2] < _CONTRADICTED:
        return found
    log = np.where(drifts, 0.5 * np.log(np.exp(prior + likely - together) @ np.exp(2.0 * grid)), 0.0)
    if np.abs(log - np.log(found.drift.pace)).max() < _CHANGED:
        return found
    drift = replace(found.drift, pace=tuple(np.exp(log).tolist()))
    learnt = follow(replace(found, drift=drift, outcomes=found.outcomes[: count - used]))
    if learnt.calibration_due is not None and count - used > 1:
        # The sessions before may have been judged under a pace that was never theirs.
        learnt = follow(replace(found, drift=drift, outcomes=found.outcomes[:1]))
    return replace(learnt, resumed=found.resumed)


@dataclass(frozen=True)
class FittedFactor:
    """A factor on random walks and its interval; 0 or infinity where the likelihood does not end it."""

    names: tuple[str, ...]
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class FittedSizes:
    """Result of `fit_sizes`."""

    stated: DriftModel
    factors: tuple[FittedFactor, ...]  # of the robot, and of mirror and fibre, where they drift
    log_likelihood: float

    @property
    def pace(self) -> tuple[float, float]:
        """Factors of the robot, and of mirror and fibre; 1 for what does not walk."""
        found = {factor.names: factor.value for factor in self.factors}
        robot, mirror = (found.get(names, 1.0) for names in self.stated.drifting)
        return robot, mirror

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
                for factor, name, unit, stated in self.walks()
            },
        }

    def lines(self) -> list[str]:
        """The sizes beside those of the cell, in words."""
        lines = [f"random walks after one day that these sessions support, with {LEVEL:.0%} intervals:"]
        for factor, name, unit, stated in self.walks():
            fitted, low, high = (f"{stated * size:.2g}" for size in (factor.value, factor.low, factor.high))
            lines.append(f"  {name} {fitted} {unit} ({low} to {high}); the cell states {stated:.2g}")
        return lines

    def walks(self) -> list[tuple[FittedFactor, str, str, float]]:
        """Factor, name, unit and stated walk in that unit of each parameter that drifts."""
        sizes = {size.name: size.walk for size in self.stated.sizes}
        named = [(factor, self.stated.parameters[name]) for factor in self.factors for name in factor.names]
        return [(factor, p.name, p.unit, float(p.shown(sizes[p.name]))) for factor, p in named]


def fit_sizes(found: Track, parts: list[Sweeps]) -> FittedSizes:
    """Factors on the walks of robot, and of mirror and fibre, that sessions support, or `InputError`."""
    if len(found.outcomes) < 2:
        raise InputError(f"{parts[0].file}: expected sessions after the calibration to learn drift from")
    which = [i for i, names in enumerate(found.drift.drifting) if names]
    if not which:
        raise InputError(f"no parameter of cell {found.cell.name!r} walks: expected a starting size in its drift")
    grid = np.stack(np.meshgrid(*[_FITTED if i in which else [0.0] for i in range(2)], indexing="ij"), axis=-1)
    likely = _log_likelihood(found, parts, 0, np.exp(grid.reshape(-1, 2))).reshape(grid.shape[:2])
    factors = [
        FittedFactor(found.drift.drifting[i], *profile_interval(_FITTED, likely.max(axis=1 - i), LEVEL)) for i in which
    ]
    return FittedSizes(found.drift, tuple(factors), float(likely.max()))


def profile_interval(log_factors: Floats, profile: Floats, level: float) -> tuple[float, float, float]:
    """Likeliest factor, ends of its interval by the likelihood ratio; 0 or infinity beyond the grid."""
    fine = np.linspace(log_factors[0], log_factors[-1], 50 * (len(log_factors) - 1) + 1)
    smooth = interpolate.CubicSpline(log_factors, np.maximum(profile, profile.max() - 50.0))(fine)
    within = np.flatnonzero(smooth > smooth.max() - 0.5 * float(special.chdtri(1, 1.0 - level)))
    low = 0.0 if within[0] == 0 else float(np.exp(fine[within[0]]))
    high = float("inf") if within[-1] == len(fine) - 1 else float(np.exp(fine[within[-1]]))
    return float(np.exp(fine[smooth.argmax()])), low, high
