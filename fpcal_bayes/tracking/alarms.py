"""Is all as modelled? Tests of a session's innovation, alone and with those of the sessions before it.

A jump of the parameters at one session shows in the innovations of that session and of the next ones. For each recent
session that may hold a jump, the innovations since are regressed on it (generalised likelihood ratio, Willsky & Jones
1976). What a jump of the extrinsic parameters explains speaks for a knock; what it leaves speaks for the robot itself.

Every test has its share of a rate of false alarms, stated per week, so that frequent sessions raise no more false
alarms than rare ones.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fpcal_bayes.core.linalg import chi2_tail, counted
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.filter import Innovation

SessionVerdict = Literal["as-modelled", "extrinsics-moved", "intrinsics-moved", "mechanics-moved"]
#: After these a full calibration is due.
ROBOT_MOVED = ("intrinsics-moved", "mechanics-moved")

HOURS_PER_WEEK = 168.0


@dataclass(frozen=True)
class Limits:
    """When a session is called inconsistent."""

    full_per_week: float = 0.014  # false alarms a week that call for a full calibration
    extrinsic_per_week: float = 0.02  # those that only widen the extrinsic parameters
    looks: int = 3  # for how many sessions a jump is looked for after it
    window: int = 6  # number of sessions whose innovations are summed
    knock_deg: float = 0.1  # standard deviation of a jump of an extrinsic parameter
    knock_um: float = 20.0
    change_deg: float = 0.1  # the same of an intrinsic parameter
    change_um: float = 2.0

    def jump(self, drift: DriftModel) -> Floats:
        """Standard deviations of a jump of each parameter in the units of the state, shape (n_parameters,)."""
        deg = np.pi / 180.0
        sizes = {
            ("extrinsic", "deg"): self.knock_deg * deg,
            ("extrinsic", "um"): self.knock_um,
            ("intrinsic", "deg"): self.change_deg * deg,
            ("intrinsic", "um"): self.change_um,
        }
        # Other units (a gain) have no jump of their own: their prior is wide enough.
        return np.array([sizes.get((p.kind, p.unit), p.prior_sd) / p.prior_sd for p in drift.parameters])


@dataclass(frozen=True)
class Onset:
    """A session that may hold a jump, in units of `Limits.jump`, and what the innovations since say about it."""

    session: str  # name of the session before which the parameters may have jumped
    hours: float  # time since the session before it
    age: int  # number of sessions since, itself included
    response: Floats  # what is left of a jump in the error of the state now, shape (n_states, n_parameters)
    information: Floats  # of the regression, shape (n_parameters, n_parameters)
    score: Floats  # likewise, shape (n_parameters,)
    squared: float  # sum of normalised innovations squared since
    dof: int  # of their degrees of freedom

    def with_session(self, innovation: Innovation, gain: Floats, predicted_response: Floats) -> "Onset":
        """With one more session, taken in by `gain`; `predicted_response` is `response` carried to its time."""
        seen = innovation.jacobian @ predicted_response
        whitened = innovation.whiten(seen)
        return Onset(
            self.session,
            self.hours,
            self.age + 1,
            predicted_response - gain @ seen,
            self.information + whitened.T @ whitened,
            self.score + whitened.T @ innovation.whitened,
            self.squared + innovation.squared,
            self.dof + innovation.dof,
        )


@dataclass(frozen=True)
class Finding:
    """One test that failed."""

    verdict: SessionVerdict  # what it speaks for
    limit: float  # what the probability of such a value had to be below
    evidence: str


@dataclass(frozen=True)
class Monitor:
    """What the tests remember from session to session."""

    onsets: tuple[Onset, ...] = ()  # sessions that may hold a jump, oldest first
    recent: tuple[tuple[float, int], ...] = ()  # innovation squared and degrees of freedom, oldest first
    cusum_extrinsic: float = 0.0  # cumulative sum of normal scores: of what extrinsic parameters could explain
    cusum_residual: float = 0.0  # of the rest


#: A cumulative sum of normal scores above 0.5 that reaches this does so by chance once in 2,000 weeks of 8-hourly
#: sessions (Siegmund 1985: mean run length 2 exp(h + 1.17)).
CUSUM_LIMIT = 10.0
_CUSUM_SLACK = 0.5
#: Directions of an extrinsic jump count as seen when a jump stands out by this many standard deviations.
_SEEN = 1.0
#: Extrinsic jumps up to this many times their standard deviation must not look like changes of the robot.
_NUISANCE = 3.0
#: Shares of the full-calibration alarms: tests of single parameters, and of the whole residual.
_SINGLE_SHARE = 0.85


def extend(
    monitor: Monitor,
    session: str,
    hours: float,
    innovation: Innovation,
    gain: Floats,
    matrix: Floats,
    limits: Limits,
    drift: DriftModel,
) -> Monitor:
    """Take a session into the memory of the tests, `hours` and the transition `matrix` after the one before."""
    fresh = _fresh(session, hours, limits, drift)
    onsets = [onset.with_session(innovation, gain, matrix @ onset.response) for onset in monitor.onsets]
    onsets.append(fresh.with_session(innovation, gain, fresh.response))
    explained, seen = _explained(onsets[-1], drift.extrinsic)
    return Monitor(
        tuple(onset for onset in onsets if onset.age <= limits.looks),
        (*monitor.recent, (innovation.squared, innovation.dof))[-limits.window :],
        _summed(monitor.cusum_extrinsic, explained, seen),
        _summed(monitor.cusum_residual, innovation.squared - explained, innovation.dof - seen),
    )


def _fresh(session: str, hours: float, limits: Limits, drift: DriftModel) -> Onset:
    """A session just before which the parameters may have jumped, nothing being measured yet."""
    n = drift.n_parameters
    start = np.eye(drift.n_states, n) * limits.jump(drift)
    return Onset(session, hours, 0, start, np.zeros((n, n)), np.zeros(n), 0.0, 0)


def _summed(total: float, squared: float, dof: int) -> float:
    """A cumulative sum with one more chi-square value, as a normal score."""
    if dof == 0:
        return total
    score = -float(special.ndtri(min(max(chi2_tail(squared, dof), 1e-12), 1.0 - 1e-12)))
    return max(0.0, total + score - _CUSUM_SLACK)


def findings(monitor: Monitor, limits: Limits, drift: DriftModel, step_gain: float = 0.0) -> list[Finding]:
    """Tests that fail, calls to calibrate first; an earlier change must gain more than the knock's `step_gain`."""
    last, found = monitor.onsets[-1], []
    for onset in monitor.onsets:
        found += _single_findings(onset, 0.0 if onset is last else step_gain, limits, drift)

    def chi_square(verdict: SessionVerdict, value: float, dof: int, allowed: float, evidence: str) -> None:
        p_value = chi2_tail(value, dof) if dof > 0 else 1.0
        if p_value < allowed:
            recent, directions = counted(len(monitor.recent), "session"), counted(dof, "direction")
            free = f"{counted(dof, 'degree')} of freedom"
            said = evidence.format(value=value, free=free, session=last.session, recent=recent, directions=directions)
            found.append(Finding(verdict, allowed, f"{said} (p = {p_value:.1e})"))

    def several(verdict: SessionVerdict, total: float, what: str) -> None:
        if total > CUSUM_LIMIT:
            said = f"{what} for several sessions (cumulative sum {total:.1f}, limit {CUSUM_LIMIT:g})"
            found.append(Finding(verdict, 0.0, said))

    explained, seen = _explained(last, drift.extrinsic)
    text = "after the best move of mirror and fibre before session {session} a chi-square of {value:.1f} is left "
    text += "for {free}"
    allowed = (1.0 - _SINGLE_SHARE) * _allowed(limits.full_per_week, last.hours)
    chi_square("intrinsics-moved", last.squared - explained, last.dof - seen, allowed, text)
    several("intrinsics-moved", monitor.cusum_residual, "what no move of mirror and fibre explains has been too large")
    # Innovation alone, extrinsic part alone, window: a third of the alarms each.
    allowed = _allowed(limits.extrinsic_per_week, last.hours) / 3.0
    text = "normalised innovation squared {value:.1f} for {free}"
    chi_square("extrinsics-moved", *monitor.recent[-1], allowed, text)
    move = "a move of mirror or fibre before session {session} explains a chi-square of {value:.1f} in {directions}"
    chi_square("extrinsics-moved", explained, seen, allowed, move)
    squared, dof = zip(*monitor.recent, strict=True)
    chi_square("extrinsics-moved", sum(squared), sum(dof), allowed, text + " over the last {recent}")
    several("extrinsics-moved", monitor.cusum_extrinsic, "mirror and fibre have moved more than modelled")
    return found


def power(innovation: Innovation, hours: float, limits: Limits, drift: DriftModel) -> Floats:
    """Probability that a session, measured or planned, shows a jump of each parameter (n,); zero for extrinsic ones."""
    intrinsic = ~drift.extrinsic
    onset = _fresh("", hours, limits, drift)
    onset = onset.with_session(innovation, np.zeros((drift.n_states, len(innovation.misfit))), onset.response)
    information = _single_jumps(onset, drift.extrinsic)[2]
    limit = _SINGLE_SHARE * _allowed(limits.full_per_week, hours) * _shares(limits, drift)[intrinsic]
    result = np.zeros(drift.n_parameters)
    result[intrinsic] = np.where(information > 0, special.ndtr(np.sqrt(information) + special.ndtri(limit / 2.0)), 0.0)
    return result


def _single_findings(onset: Onset, least_gain: float, limits: Limits, drift: DriftModel) -> list[Finding]:
    """The parameter of the robot whose jump alone stands out most, if one does."""
    scores, sizes, _, gain = _single_jumps(onset, drift.extrinsic)
    p_values = 2.0 * special.ndtr(-np.abs(scores))
    limit = _SINGLE_SHARE * _allowed(limits.full_per_week, onset.hours) * _shares(limits, drift)[~drift.extrinsic]
    passed = (p_values < limit) & (gain > least_gain)
    if not passed.any():
        return []
    at = int(np.argmin(np.where(passed, p_values / limit, np.inf)))
    position = int(np.flatnonzero(~drift.extrinsic)[at])
    parameter = drift.parameters[position]
    size = sizes[at] * limits.jump(drift)[position] * parameter.prior_sd
    evidence = (
        f"{parameter.name} moved by {parameter.shown(size):+.3g} {parameter.unit} before session {onset.session} "
        f"beyond its drift, {abs(scores[at]):.1f} sd, which no move of mirror or fibre explains"
    )
    return [Finding("intrinsics-moved", float(limit[at]), evidence)]


def _allowed(per_week: float, hours: float) -> float:
    return per_week * min(max(hours, 0.25), HOURS_PER_WEEK) / HOURS_PER_WEEK


def _shares(limits: Limits, drift: DriftModel) -> Floats:
    """Share of each intrinsic parameter in the false alarms: mostly to those that are known to drift."""
    weight = np.where(drift.extrinsic, 0.0, (drift.walk / limits.jump(drift)) ** 2)
    even = np.where(drift.extrinsic, 0.0, 1.0)
    drifting = weight if weight.any() else even
    return np.asarray(0.9 * drifting / max(drifting.sum(), 1e-300) + 0.1 * even / max(even.sum(), 1.0))


def _explained(onset: Onset, extrinsic: NDArray[np.bool_]) -> tuple[float, int]:
    """Chi-square that an extrinsic jump explains, and in how many directions it is seen."""
    chosen = np.flatnonzero(extrinsic)
    information, directions = np.linalg.eigh(onset.information[np.ix_(chosen, chosen)])
    along = directions.T @ onset.score[chosen]
    seen = information > _SEEN**2
    return float((along[seen] ** 2 / information[seen]).sum()), int(seen.sum())


def _single_jumps(onset: Onset, extrinsic: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats, Floats]:
    """Score, size, information, log likelihood gain of a jump of each intrinsic parameter beside an extrinsic one."""
    e, i = np.flatnonzero(extrinsic), np.flatnonzero(~extrinsic)
    own = onset.information[np.ix_(e, e)] + np.eye(len(e)) / _NUISANCE**2
    cross = onset.information[np.ix_(e, i)]
    solved = np.linalg.solve(own, np.column_stack([cross, onset.score[e]]))
    information = np.diag(onset.information)[i] - (cross * solved[:, :-1]).sum(axis=0)
    score = onset.score[i] - cross.T @ solved[:, -1]
    seen = information > _SEEN**2
    safe = np.where(seen, information, 1.0)
    scores = np.where(seen, score / np.sqrt(safe), 0.0)
    # Of a jump with unit variance: the likelihood of the score is N(0, 1 + information) rather than N(0, 1).
    gain = np.where(seen, 0.5 * (scores**2 * safe / (1.0 + safe) - np.log1p(safe)), -np.inf)
    return scores, np.where(seen, score / safe, 0.0), np.where(seen, information, 0.0), gain
