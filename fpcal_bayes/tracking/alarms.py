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

    # full_per_week, extrinsic_per_week: false alarms a week that call for a full calibration, and that only widen the
    # extrinsic parameters
    full_per_week: float = 0.014
    extrinsic_per_week: float = 0.02
    looks: int = 3  # for how many sessions a jump is looked for after it
    window: int = 6  # number of sessions whose innovations are summed
    # knock_deg, knock_um: standard deviation of a jump of an extrinsic parameter
    knock_deg: float = 0.1
    knock_um: float = 20.0
    # change_deg, change_um: the same of an intrinsic parameter
    change_deg: float = 0.1
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
    """A session that may hold a jump, and what the innovations since say about it.

    The jump is in units of `Limits.jump`.
    """

    session: str  # name of the session before which the parameters may have jumped
    hours: float  # time since the session before it
    age: int  # number of sessions since, itself included
    response: Floats  # what is left of a jump in the error of the state now, shape (n_states, n_parameters)
    # information, score: of the regression, shapes (n_parameters, n_parameters) and (n_parameters,)
    information: Floats
    score: Floats
    # squared, dof: sum of normalised innovations squared since, and of their degrees of freedom
    squared: float
    dof: int

    def with_session(self, innovation: Innovation, gain: Floats, predicted_response: Floats) -> "Onset":
        """With the innovation of one more session.

        `gain` (n_states, n_equivalent) is the Kalman gain by which the session was taken in, `predicted_response` is
        `response` carried to its time.
        """
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
    p_value: float  # probability of such a value if all is as modelled, and what it had to be below
    limit: float
    evidence: str


@dataclass(frozen=True)
class Monitor:
    """What the tests remember from session to session."""

    onsets: tuple[Onset, ...] = ()  # sessions that may hold a jump, oldest first
    # normalised innovation squared and degrees of freedom of the last sessions, oldest first
    recent: tuple[tuple[float, int], ...] = ()
    # cumulative sums of normal scores: of what extrinsic parameters could explain, and of the rest
    cusum_extrinsic: float = 0.0
    cusum_residual: float = 0.0


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
    """Take a session into the memory of the tests.

    `hours` have passed since the session before, `matrix` (n_states, n_states) is the transition of the state over
    them; linearisation (`innovation`) and `gain` of the session belong together.
    """
    start = np.zeros((drift.n_states, drift.n_parameters))
    start[range(drift.n_parameters), range(drift.n_parameters)] = limits.jump(drift)
    n = drift.n_parameters
    fresh = Onset(session, hours, 0, start, np.zeros((n, n)), np.zeros(n), 0.0, 0)
    onsets = [onset.with_session(innovation, gain, matrix @ onset.response) for onset in monitor.onsets]
    onsets.append(fresh.with_session(innovation, gain, start))
    explained, seen = _explained(onsets[-1], drift.extrinsic)
    rest = innovation.dof - seen
    return Monitor(
        tuple(onset for onset in onsets if onset.age <= limits.looks),
        (*monitor.recent, (innovation.squared, innovation.dof))[-limits.window :],
        _summed(monitor.cusum_extrinsic, explained, seen),
        _summed(monitor.cusum_residual, innovation.squared - explained, rest),
    )


def _summed(total: float, squared: float, dof: int) -> float:
    """A cumulative sum with one more chi-square value, as a normal score."""
    if dof == 0:
        return total
    score = -float(special.ndtri(min(max(chi2_tail(squared, dof), 1e-12), 1.0 - 1e-12)))
    return max(0.0, total + score - _CUSUM_SLACK)


def findings(monitor: Monitor, limits: Limits, drift: DriftModel, step_gain: float = 0.0) -> list[Finding]:
    """Tests that fail after a session that `extend` took in, those that call for a full calibration first.

    `step_gain` is by how much a knock just before the last session raises the log likelihood of that session. A change
    of the robot before an earlier session is believed only if it raises the likelihood more.
    """
    return [*_full_findings(monitor, limits, drift, step_gain), *_extrinsic_findings(monitor, limits, drift)]


def power(innovation: Innovation, hours: float, limits: Limits, drift: DriftModel) -> Floats:
    """Probability that a session shows that a parameter of the robot jumped by its size in `Limits.jump` before it.

    Only the linearisation of `innovation` counts: the session may be measured or planned. `hours` have passed since the
    session before. Shape (n_parameters,); zero for extrinsic parameters, which are not what is looked for.
    """
    n, intrinsic = drift.n_parameters, ~drift.extrinsic
    start = np.zeros((drift.n_states, n))
    start[range(n), range(n)] = limits.jump(drift)
    onset = Onset("", hours, 0, start, np.zeros((n, n)), np.zeros(n), 0.0, 0)
    onset = onset.with_session(innovation, np.zeros((drift.n_states, len(innovation.misfit))), start)
    information = _single_jumps(onset, drift.extrinsic).information
    limit = _SINGLE_SHARE * _allowed(limits.full_per_week, hours) * _shares(limits, drift)[intrinsic]
    result = np.zeros(n)
    result[intrinsic] = np.where(information > 0, special.ndtr(np.sqrt(information) + special.ndtri(limit / 2.0)), 0.0)
    return result


def _full_findings(monitor: Monitor, limits: Limits, drift: DriftModel, step_gain: float) -> list[Finding]:
    found: list[Finding] = []
    extrinsic = drift.extrinsic
    shares = _shares(limits, drift)
    for onset in monitor.onsets:
        allowed = _SINGLE_SHARE * _allowed(limits.full_per_week, onset.hours)
        single = _single_jumps(onset, extrinsic)
        p_values = 2.0 * special.ndtr(-np.abs(single.scores))
        limit = allowed * shares[~extrinsic]
        passed = (p_values < limit) & (single.gain > (0.0 if onset is monitor.onsets[-1] else step_gain))
        if passed.any():
            at = int(np.argmin(np.where(passed, p_values / limit, np.inf)))
            position = int(np.flatnonzero(~extrinsic)[at])
            parameter = drift.parameters[position]
            size = single.sizes[at] * limits.jump(drift)[position] * parameter.prior_sd
            evidence = (
                f"{parameter.name} moved by {parameter.shown(size):+.3g} {parameter.unit} before session "
                f"{onset.session} beyond its drift, {abs(single.scores[at]):.1f} sd, which no move of mirror or fibre "
                "explains"
            )
            found.append(Finding("intrinsics-moved", float(p_values[at]), float(limit[at]), evidence))
    onset = monitor.onsets[-1]
    explained, directions = _explained(onset, extrinsic)
    rest = onset.dof - directions
    if rest > 0:
        p_value = chi2_tail(onset.squared - explained, rest)
        allowed = (1.0 - _SINGLE_SHARE) * _allowed(limits.full_per_week, onset.hours)
        if p_value < allowed:
            evidence = (
                f"after the best move of mirror and fibre before session {onset.session} a chi-square of "
                f"{onset.squared - explained:.1f} is left for {rest} degrees of freedom (p = {p_value:.1e})"
            )
            found.append(Finding("intrinsics-moved", p_value, allowed, evidence))
    if monitor.cusum_residual > CUSUM_LIMIT:
        evidence = (
            "what no move of mirror and fibre explains has been too large for several sessions (cumulative sum "
            f"{monitor.cusum_residual:.1f}, limit {CUSUM_LIMIT:g})"
        )
        found.append(Finding("intrinsics-moved", 0.0, 0.0, evidence))
    return found


def _extrinsic_findings(monitor: Monitor, limits: Limits, drift: DriftModel) -> list[Finding]:
    found: list[Finding] = []
    extrinsic = drift.extrinsic
    onset = monitor.onsets[-1]
    # Innovation alone, extrinsic part alone, window: a third of the alarms each.
    allowed = _allowed(limits.extrinsic_per_week, onset.hours) / 3.0
    squared, dof = monitor.recent[-1]
    p_value = chi2_tail(squared, dof)
    if p_value < allowed:
        evidence = f"normalised innovation squared {squared:.1f} for {dof} degrees of freedom (p = {p_value:.1e})"
        found.append(Finding("extrinsics-moved", p_value, allowed, evidence))
    explained, directions = _explained(onset, extrinsic)
    if directions > 0:
        p_value = chi2_tail(explained, directions)
        if p_value < allowed:
            evidence = (
                f"a move of mirror or fibre before session {onset.session} explains a chi-square of {explained:.1f} "
                f"in {counted(directions, 'direction')} (p = {p_value:.1e})"
            )
            found.append(Finding("extrinsics-moved", p_value, allowed, evidence))
    total, count = (sum(column) for column in zip(*monitor.recent, strict=True))
    p_value = chi2_tail(total, count)
    if p_value < allowed:
        evidence = (
            f"normalised innovation squared {total:.1f} for {count} degrees of freedom over the last "
            f"{counted(len(monitor.recent), 'session')} (p = {p_value:.1e})"
        )
        found.append(Finding("extrinsics-moved", p_value, allowed, evidence))
    if monitor.cusum_extrinsic > CUSUM_LIMIT:
        evidence = (
            "mirror and fibre have moved more than modelled for several sessions (cumulative sum "
            f"{monitor.cusum_extrinsic:.1f}, limit {CUSUM_LIMIT:g})"
        )
        found.append(Finding("extrinsics-moved", 0.0, 0.0, evidence))
    return found


def _allowed(per_week: float, hours: float) -> float:
    """Share of a rate of false alarms that falls on a session."""
    return per_week * min(max(hours, 0.25), HOURS_PER_WEEK) / HOURS_PER_WEEK


def _shares(limits: Limits, drift: DriftModel) -> Floats:
    """Share of each intrinsic parameter in the false alarms: mostly to those that are known to drift."""
    weight = np.where(drift.extrinsic, 0.0, (drift.walk / limits.jump(drift)) ** 2)
    even = np.where(drift.extrinsic, 0.0, 1.0)
    drifting = weight if weight.any() else even
    result: Floats = 0.9 * drifting / max(drifting.sum(), 1e-300) + 0.1 * even / max(even.sum(), 1.0)
    return result


def _explained(onset: Onset, extrinsic: NDArray[np.bool_]) -> tuple[float, int]:
    """Chi-square that an extrinsic jump explains, and in how many directions it is seen."""
    chosen = np.flatnonzero(extrinsic)
    information, directions = np.linalg.eigh(onset.information[np.ix_(chosen, chosen)])
    along = directions.T @ onset.score[chosen]
    seen = information > _SEEN**2
    return float((along[seen] ** 2 / information[seen]).sum()), int(seen.sum())


@dataclass(frozen=True)
class _SingleJumps:
    """A jump of each intrinsic parameter alone: standard score, size, information, gain in log likelihood."""

    scores: Floats
    sizes: Floats
    information: Floats
    gain: Floats


def _single_jumps(onset: Onset, extrinsic: NDArray[np.bool_]) -> _SingleJumps:
    """Regression on each intrinsic parameter alone; a jump of the extrinsic ones at the same session is allowed for."""
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
    return _SingleJumps(scores, np.where(seen, score / safe, 0.0), np.where(seen, information, 0.0), gain)
