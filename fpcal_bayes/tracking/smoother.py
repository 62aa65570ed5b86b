"""Session after session: each is taken in, and now and then all are looked at again from where they lead.

An update leaves the rows of its session linearised where the state was then. While the first sessions still move the
state through a bend of the model, what that linearisation says of the place where the state ends is off, and the filter
claims more than it knows. So after the second session, the fourth, the eighth, and so on, the state becomes the last
one of the iterated smoother: all sessions linearised again where they lead together. As the intervals double, that
costs a few smoothings' worth in all. After a jump was allowed for the state is wide again: then each of the next
sessions is followed by a look, and a second count begins.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fpcal_bayes.core.linalg import symmetric
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.filter import kalman, kelvin_between, take_rows
from fpcal_bayes.tracking.measurement import Measurement, equivalent_rows
from fpcal_bayes.tracking.session import SessionOutcome, take_in

#: The iteration ends when a step is shorter than this, in standard deviations of what drives the trajectory.
_STEP_TOLERANCE = 1e-2
_MOST_STEPS = 60
_MOST_HALVINGS = 10
#: What rounding may add to the sum of squares.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Smoothed:
    """States given all sessions."""

    states: tuple[State, ...]  # after each session, in order of time
    # by which what a later state tells reaches the one before, shape (n_times, n_states, n_states); the last is zero
    gains: Floats
    converged: bool  # whether the iteration came to rest


def smooth(drift: DriftModel, outcomes: Sequence[SessionOutcome]) -> Smoothed:
    """States after each session given all; a calibration without its measurement is taken as its state is."""
    if len(outcomes) == 1:
        return Smoothed((outcomes[0].state,), np.zeros((1, drift.n_states, drift.n_states)), outcomes[0].converged)
    course = _Course.of(drift, outcomes)
    means = np.array([outcome.state.mean for outcome in outcomes]) - course.shifts
    trajectory = course.smoothed(means, np.array([outcome.state.covariance for outcome in outcomes]))
    cost, converged = course.cost(trajectory), False
    for _ in range(_MOST_STEPS):
        wanted = course.smoothed(*course.filtered(trajectory.means))
        step, pull = wanted.means - trajectory.means, wanted.pulls - trajectory.pulls
        length = float(np.sqrt(course.squares(pull)))
        share = 1.0
        for _ in range(_MOST_HALVINGS):
            trial = replace(wanted, means=trajectory.means + share * step, pulls=trajectory.pulls + share * pull)
            trial_cost = course.cost(trial)
            if trial_cost <= cost + _ROUNDING * (1.0 + cost):
                break
            share /= 2.0
        else:
            break
        trajectory, cost = trial, trial_cost
        if length < _STEP_TOLERANCE:
            converged = True
            break
    states = tuple(
        replace(outcome.state, mean=mean, covariance=symmetric(covariance))
        for outcome, mean, covariance in zip(
            outcomes, trajectory.means + course.shifts, trajectory.covariances, strict=True
        )
    )
    return Smoothed(states, trajectory.gains, converged)


def with_measurements(
    drift: DriftModel, model: CavityModel, limits: Limits, outcomes: Sequence[SessionOutcome], parts: Sequence[Sweeps]
) -> list[SessionOutcome]:
    """Outcomes from the calibration on with their measurements; sessions of an earlier run are read again."""
    found = list(outcomes[:1])
    for (before, outcome), part in zip(pairwise(outcomes), parts[1:], strict=False):
        if outcome.measurement is None and outcome.n_sweeps:
            again = take_in(drift, model, limits, before.state, before.monitor, part)
            outcome = replace(outcome, measurement=again.measurement)
        found.append(outcome)
    return found


@dataclass(frozen=True)
class _Trajectory:
    """States at all times, and what drives them there."""

    means: Floats  # of the states less their known shifts, shape (n_times, n_states)
    covariances: Floats  # shape (n_times, n_states, n_states)
    # the state before any session is start + covariance @ pull, and what the drift adds at each later time is noise @
    # pull; shape (n_times, n_states)
    pulls: Floats
    gains: Floats  # see `Smoothed`


@dataclass(frozen=True)
class _Course:
    """The sessions, the steps between them, and where they start; all without the shifts by a known temperature."""

    start: State  # before the first measurement
    matrices: Floats  # of the step into each time, shape (n_times, n_states, n_states)
    noises: Floats  # likewise
    shifts: Floats  # sum of the known shifts up to each time, shape (n_times, n_states)
    measurements: list[Measurement | None]  # one a time, or None

    @classmethod
    def of(cls, drift: DriftModel, outcomes: Sequence[SessionOutcome]) -> "_Course":
        n = drift.n_states
        matrices, noises, shifts = [np.eye(n)], [np.zeros((n, n))], [np.zeros(n)]
        for before, outcome in pairwise(outcomes):
            if outcome.measurement is None and outcome.n_sweeps:
                raise ValueError(f"session {outcome.session!r} comes without its measurement: expected it")
            now = outcome.predicted
            kelvin = kelvin_between(before.state.temperature_c, now.temperature_c)
            step = drift.transition(now.time_h - before.state.time_h, kelvin)
            matrices.append(step.matrix)
            noises.append(step.noise + np.diag(outcome.jump**2))
            shifts.append(step.matrix @ shifts[-1] + step.shift)
        start = outcomes[0].state
        if outcomes[0].measurement is not None:
            # All states are in units of their prior.
            start = replace(start, mean=np.zeros(n), covariance=np.eye(n))
        return cls(start, np.array(matrices), np.array(noises), np.array(shifts), [o.measurement for o in outcomes])

    def filtered(self, at: Floats) -> tuple[Floats, Floats]:
        """Means and covariances after each session, its rows linearised at `at`, shape (n_times, n_states)."""
        means, covariances = [], []
        state = self.start
        for matrix, noise, shift, point, measurement in zip(
            self.matrices, self.noises, self.shifts, at, self.measurements, strict=True
        ):
            filtered = kalman(state)
            filtered.predict(F=matrix, Q=noise)
            if measurement is not None:
                misfit, jacobian = measurement.linearise(point + shift)
                rows, derivatives = equivalent_rows(misfit + jacobian @ point, jacobian)
                take_rows(filtered, rows, derivatives)
            state = replace(state, mean=filtered.x, covariance=symmetric(filtered.P))
            means.append(state.mean)
            covariances.append(state.covariance)
        return np.array(means), np.array(covariances)

    def smoothed(self, means: Floats, covariances: Floats) -> _Trajectory:
        # The method of the class uses the transition into each time; the function of the module does not.
        smoothed, spread, gains, predicted = kalman(self.start).rts_smoother(
            means, covariances, self.matrices, self.noises
        )
        pulls = np.zeros_like(means)
        expected = np.einsum("kij,kj->ki", self.matrices[1:], means[:-1])
        pulls[1:] = np.linalg.solve(predicted[:-1], (smoothed[1:] - expected)[..., None])[..., 0]
        pulls[0] = self.matrices[1].T @ pulls[1]
        if self.measurements[0] is not None:
            pulls[0] = np.linalg.solve(self.start.covariance, smoothed[0] - self.start.mean)
        return _Trajectory(smoothed, spread, pulls, gains)

    def squares(self, pulls: Floats) -> float:
        """Sum of squares of what drives a trajectory, in its standard deviations."""
        noises = np.concatenate([self.start.covariance[None], self.noises[1:]])
        return max(float(np.einsum("ki,kij,kj->", pulls, noises, pulls)), 0.0)

    def cost(self, trajectory: _Trajectory) -> float:
        """Sum of squares of what drives the trajectory and of the rows."""
        total = self.squares(trajectory.pulls)
        for place, measurement in zip(trajectory.means + self.shifts, self.measurements, strict=True):
            if measurement is not None:
                misfit = measurement.misfit(place)
                total += float(misfit @ misfit)
        return total


#: So many sessions are looked at again, at most: what was before hardly moves the state any more.
_MOST_SESSIONS = 64
#: So many sessions after a jump each is followed by such a look.
_AFTER_JUMP = 8


def follow_sessions(
    drift: DriftModel, model: CavityModel, limits: Limits, known: Sequence[SessionOutcome], parts: Sequence[Sweeps]
) -> list[SessionOutcome]:
    """Take in the sessions `parts`, in order of time, after those that are known; `drift` has its `hidden` noise."""
    outcomes = list(known)
    for part in parts[len(outcomes) :]:
        before = outcomes[-1]
        outcomes.append(take_in(drift, model, limits, before.state, before.monitor, part))
        if _is_due(outcomes):
            first = max(0, len(outcomes) - _MOST_SESSIONS)
            outcomes[first:] = with_measurements(drift, model, limits, outcomes[first:], parts[first:])
            outcomes[-1] = looked_at_again(drift, outcomes)
    return outcomes


def looked_at_again(drift: DriftModel, outcomes: Sequence[SessionOutcome]) -> SessionOutcome:
    """The last outcome; where a look is due, with the state to which all sessions lead together."""
    last = outcomes[-1]
    if not _is_due(outcomes):
        return last
    recent = list(outcomes[-_MOST_SESSIONS:])
    if len(recent) < len(outcomes):
        recent[0] = replace(recent[0], measurement=None)
    smoothed = smooth(drift, recent)
    return replace(last, state=smoothed.states[-1]) if smoothed.converged else last


def _is_due(outcomes: Sequence[SessionOutcome]) -> bool:
    count = len(outcomes) - 1
    alarms = [number for number, outcome in enumerate(outcomes) if outcome.jump.any()]
    since = count - alarms[-1] if alarms else 0
    return count > 1 and (count.bit_count() == 1 or 0 < since <= _AFTER_JUMP or since.bit_count() == 1)
