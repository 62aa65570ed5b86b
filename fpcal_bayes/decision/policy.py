"""The policy for one cell: what it must hold, what measuring costs, and which sweeps there are to choose from.

Sweeps are chosen by `infer.design`: those that leave the least expected error of the tasks, given all that is known.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.decision import Costs, Decision, decide, session_of
from fpcal_bayes.decision.diagnosis import LEAST_POWER, last_diagnosis, most_power, session_power, watched
from fpcal_bayes.decision.forecast import Forecaster, Goal
from fpcal_bayes.infer.design.candidates import (
    SweepLimits,
    can_be_followed,
    candidate_sweeps,
    reverses,
    tilts,
    visible_ranges,
)
from fpcal_bayes.infer.design.exchange import choose_sweeps
from fpcal_bayes.infer.design.rows import sweep_rows
from fpcal_bayes.measure.protocol import motions_alone, seen_by_all
from fpcal_bayes.measure.sweeps import Sweeps, as_plan, join
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.envelope import require_within_envelope
from fpcal_bayes.model.margin import normal_draws, prior_draws
from fpcal_bayes.tracking.alarms import HOURS_PER_WEEK, Limits
from fpcal_bayes.tracking.drift import HOURS_PER_DAY, DriftModel, State
from fpcal_bayes.tracking.tracker import Track


def task_sweeps(model: CavityModel, values: Floats, poses: Floats, limits: SweepLimits | None = None) -> Sweeps:
    """Sweeps of one joint through `poses` (n_poses, n_joints) with fringes; `InputError` if there are none at 0."""
    limits = SweepLimits() if limits is None else limits
    low, high = visible_ranges(model, values, limits)
    n_poses, n_joints = poses.shape
    start = np.repeat(np.clip(poses, low, high), n_joints, axis=0)
    end = start.copy()
    rows, joint = np.arange(len(start)), np.tile(np.arange(n_joints), n_poses)
    start[rows, joint], end[rows, joint] = low[joint], high[joint]
    good = (high > low)[joint] & can_be_followed(model, values, start, end, limits)
    return Sweeps.of_um_rad(start[good], end[good], label=[f"q{j + 1}" for j in joint[good]], file="task sweeps")


#: Random sweeps to choose from, beside those of the calibration.
_CANDIDATES = 300
#: Random halves of the candidates among which a look at the robot is sought, beside the whole.
_HALVES = 4
#: Jumps of mirror and fibre that a look at the robot allows for, in units of `Limits.jump`.
_NUISANCE = 3.0


@dataclass(frozen=True)
class _Pool:
    """Sweeps to choose from, and their whitened rows by the scaled state, shape (1, n_candidates, 1, n_lengths)."""

    candidates: Sweeps
    rows: Floats

    def take(self, which: NDArray[np.int64]) -> "_Pool":
        return _Pool(self.candidates.take(which), self.rows[:, which])

    def choose(self, covariance: Floats, tasks: dict[str, Floats], n: int, passes: int = 0) -> Sweeps:
        goals, count = {name: jacobian[None] for name, jacobian in tasks.items()}, min(n, len(self.candidates))
        # The mean variance along the paths: the worst point alone would leave the slower directions to drift. Without
        # exchange each sweep is the best after those before it, as a session may end after any.
        chosen = choose_sweeps(self.rows, goals, count, covariance, mean=True, passes=passes)
        return self.candidates.take(np.array(chosen))


@dataclass(frozen=True)
class Policy:
    """Decides when to measure what."""

    drift: DriftModel
    model: CavityModel  # of the same parameters
    goal: Goal  # what is to be held
    costs: Costs  # what measuring costs
    candidates: Callable[[], Sweeps]  # sweeps to choose from, as a plan; made once, when first wanted
    calibration: Sweeps  # sweeps of a full calibration, as a plan
    # of the tests for changes; they say what a look at the robot can show
    limits: Limits = field(default_factory=Limits)
    motion: Callable[[], SweepLimits] = SweepLimits  # what sweeps keep to

    @classmethod
    def of(
        cls,
        drift: DriftModel,
        model: CavityModel,
        goal: Goal,
        costs: Costs,
        calibration: Sweeps,
        motion: Callable[[], SweepLimits] = SweepLimits,
    ) -> "Policy":
        """A policy that chooses among random sweeps and those of a calibration whose cavity length does not turn round.

        `InputError`, when sweeps are first wanted, if the joint limits leave no room for them.
        """
        motion = cache(motion)

        def candidates() -> Sweeps:
            single = calibration.take((calibration.kind == "sweep") & motion().hold(calibration))
            random = candidate_sweeps(model.cell, n=_CANDIDATES, rng=np.random.default_rng(0), limits=motion())
            pool = join([_plain(single), _plain(random)], file="candidates")
            return pool.take(~reverses(model, drift.parameters.nominal, pool)[0])

        return cls(drift, model, goal, costs, cache(candidates), calibration, motion=motion)

    def choose(self, forecast: Forecaster, state: State, n: int) -> Sweeps:
        """At most `n` sweeps for a session at the time of `state`, the most useful to the tasks first."""
        return self._choose_for_tasks(self._pool(forecast), forecast, state, n)

    def _choose_for_tasks(self, pool: "_Pool", forecast: Forecaster, state: State, n: int) -> Sweeps:
        m = self.drift.n_lengths
        tasks = {name: forecast.jacobian[points] for name, points in zip(self.goal.tasks, forecast.tasks, strict=True)}
        return pool.choose(state.covariance[:m, :m], tasks, n)

    def choose_diagnosis(self, forecast: Forecaster, state: State, most: int | None = None) -> Sweeps:
        """At most `most` sweeps that show best a jump of the robot's fastest drift beside one of mirror and fibre."""
        m, at = self.drift.n_lengths, watched(self.drift, self.limits)
        jump = np.zeros(m)
        jump[: self.drift.n_parameters] = self.limits.jump(self.drift) * np.where(self.drift.extrinsic, _NUISANCE, 0.0)
        jump[at] = self.limits.jump(self.drift)[at]
        wide = state.covariance[:m, :m] + np.diag(jump**2)
        whole = self._pool(forecast)
        n = min(self.costs.diagnosis_sweeps, self.costs.diagnosis_sweeps if most is None else most)
        # Together they see what no single one does: chosen by exchange, which may end in a poor optimum. Of those in
        # the whole pool and in random halves of it, the session of the greatest power is taken.
        random, count = np.random.default_rng(0), len(whole.candidates)
        pools = [whole, *(whole.take(random.permutation(count)[: max(n, count // 2)]) for _ in range(_HALVES))]
        robot = {"robot": np.eye(m)[at : at + 1]}
        found = [pool.choose(wide, robot, n, passes=5) for pool in pools]
        return max(found, key=lambda sweeps: self._power(state, sweeps, HOURS_PER_DAY))

    def _power(self, state: State, sweeps: Sweeps, hours: float) -> float:
        """Probability that sweeps at the time of `state` show a jump of the watched parameter."""
        seen = seen_by_all(sweeps, self.model.cell)
        planned = seen.with_measurement(np.zeros(len(seen)), np.full(len(seen), self.costs.sigma_um))
        found = session_power(self.drift, self.model, state, planned, hours, self.limits)
        return float(found[watched(self.drift, self.limits)])

    def _pool(self, forecast: Forecaster) -> "_Pool":
        values = self.drift.values(forecast.estimate)
        near = _plain(task_sweeps(self.model, values, forecast.poses, self.motion()))
        near = near.take(~reverses(self.model, values, near)[0])
        candidates = join([near, self.candidates()], file="candidates")
        sigma = self.costs.sigma_um
        rows = sweep_rows(self.model, values[None], candidates, readings=1, sigma=sigma) * self.drift.scale
        if self.drift.motions is not None:
            seen = seen_by_all(candidates, self.model.cell)
            none = np.zeros(len(seen))
            # Each by itself: no drift between them.
            alone = replace(seen.with_measurement(none, none + sigma), t_start_h=none, t_end_h=none)
            whitening, felt = self.drift.motions.rows(self.model, alone, values)
            lengths = rows[0].reshape(len(seen), -1) * sigma
            rows = np.hstack([lengths, felt]) / np.sqrt(whitening.variance)[:, None]
            rows = rows.reshape(1, len(candidates), -1, rows.shape[1])
        return _Pool(candidates, rows)

    def decide(
        self, forecast: Forecaster, state: State, calibration_due: str | None = None, diagnosed_h: float | None = None
    ) -> Decision:
        """What to do at the time of `state`, while the controller holds the estimate of `forecast`.

        `calibration_due` says why a full calibration is due whatever the error; `diagnosed_h` when a session could last
        show a change of the robot.
        """
        decision = self._decide(forecast, state, calibration_due)
        left = self._look_in(forecast, state, diagnosed_h)
        if decision.action == "full" or left == np.inf or diagnosed_h is None:
            return decision
        if left <= 0.0:
            return self._diagnose(decision, forecast, state, diagnosed_h)
        if decision.action == "hold" and left < decision.hold_hours:
            after = forecast.outlook(forecast.ahead(state, left))
            reason = f"the robot itself is to be looked at every {self.costs.diagnosis_h:g} h"
            return replace(decision, hold_hours=left, after=after, reason=reason)
        return decision

    def measure_now(
        self, forecast: Forecaster, state: State, calibration_due: str | None = None, diagnosed_h: float | None = None
    ) -> Decision:
        """What to measure at the time of `state`, when a session was planned for it; arguments as in `decide`."""
        decision = self._decide(forecast, state, calibration_due, measure=True)
        if decision.action == "full" or diagnosed_h is None:
            return decision
        # Rounding must not put a look off by a session.
        due = self._look_in(forecast, state, diagnosed_h) < 1e-6
        return self._diagnose(decision, forecast, state, diagnosed_h) if due else decision

    def _look_in(self, forecast: Forecaster, state: State, diagnosed_h: float | None) -> float:
        """Hours until the robot is to be looked at, negative if that is overdue; infinite if no look has power."""
        every = self.costs.diagnosis_h
        if every is None or diagnosed_h is None:
            return np.inf
        left = diagnosed_h + every - state.time_h
        then = forecast.ahead(state, max(left, 0.0))
        # Drift hides a change after long waits: then sweeps would cost time and show nothing.
        most = most_power(self.drift, then, then.time_h - diagnosed_h, self.limits)
        return left if most[watched(self.drift, self.limits)] >= LEAST_POWER else np.inf

    def hold_hours(self, forecast: Forecaster, state: State, diagnosed_h: float) -> float:
        """Hours from `state` until something is to be measured, at most the horizon; see `decide`."""
        hold = forecast.hold_hours(state, self.costs.horizon_h)
        left = self._look_in(forecast, state, diagnosed_h)
        # A session that was too weak to show a change is not repeated at once.
        if left < -1e-6:
            left = self.costs.diagnosis_h or 0.0
        return min(hold, max(0.0, left))

    def _decide(
        self, forecast: Forecaster, state: State, calibration_due: str | None, *, measure: bool = False
    ) -> Decision:
        # All sessions of a decision are chosen for one estimate, from one pool, which is made if one is wanted.
        pool = cache(lambda: self._pool(forecast))

        def choose(same: Forecaster, at: State, n: int) -> Sweeps:
            return self._choose_for_tasks(pool(), same, at, n)

        return decide(
            forecast, self.model, state, self.costs, choose, self.calibration, calibration_due, measure=measure
        )

    def _diagnose(self, decision: Decision, forecast: Forecaster, state: State, diagnosed_h: float) -> Decision:
        n_taken = 0 if decision.sweeps is None else len(decision.sweeps)
        n_left = max(self.costs.most_sweeps, self.costs.diagnosis_sweeps) - n_taken
        if n_left < 1:
            return decision
        sweeps = self.choose_diagnosis(forecast, state, n_left)
        if decision.sweeps is not None:
            sweeps = join([decision.sweeps, sweeps], file="candidates")
        hours = state.time_h - diagnosed_h
        at = watched(self.drift, self.limits)
        found = self._power(state, sweeps, hours)
        if found < LEAST_POWER:
            # Such a look would cost time and show nothing.
            count = counted(len(sweeps), "sweep")
            said = f"{count} would show a change of the robot with probability {found:.2f}: not made"
            return replace(decision, reason=f"{decision.reason}; {said}")
        most = most_power(self.drift, state, hours, self.limits)[at]
        parameter = self.drift.parameters[at]
        size = parameter.shown(self.limits.jump(self.drift)[at] * parameter.prior_sd)
        taken = session_of(forecast, self.model, state, self.costs, sweeps)
        return replace(
            decision,
            action="extrinsic",
            purpose="both" if n_taken else "robot",
            hold_hours=0.0,
            sweeps=sweeps,
            minutes=taken.minutes,
            then_hours=taken.hours,
            after=taken.outlook,
            reason=f"no session of the last {hours:.1f} h could show a change of the robot itself; these sweeps show "
            f"one of {parameter.name} by {size:.2g} {parameter.unit} with probability {found:.2f} "
            f"(any session: at most {most:.2f})",
        )


#: What `last_forecast` gave last, and for what.
_forecasts: list[tuple[Track, Forecaster]] = []


def last_forecast(track: Track, goal: Goal) -> Forecaster:
    """The forecast for the estimate after the last session; a cell that holds asks for the same again and again."""
    for known, found in _forecasts:
        if known.drift is track.drift and known.last is track.last and found.goal == goal:
            return found
    model = CavityModel.of(track.cell, track.drift.parameters)
    made = Forecaster.of(track.drift, model, goal, track.last.state.mean)
    _forecasts[:] = [(track, made)]
    return made


def _standing(
    track: Track, sweeps: Sweeps, goal: Goal, costs: Costs, now_h: float
) -> tuple[Policy, Forecaster, State, Floats]:
    """The policy for a cell that was followed so far, and what is known of it now; arguments as in `decide_track`."""
    last = track.last
    if not now_h >= last.time_h:
        raise InputError(
            f"now is {now_h:g} h, before the last session {last.session!r} at {last.time_h:g} h: expected a time after"
        )
    model = CavityModel.of(track.cell, track.drift.parameters)
    forecast = last_forecast(track, goal)
    state = forecast.ahead(last.state, now_h - last.time_h)
    # A robot that moved by itself is known as before its first calibration only.
    values, covariance = track.drift.values(state.mean), track.drift.covariance(state.covariance)
    known = normal_draws(values, covariance) if track.lasting_trust.usable else prior_draws(track.cell)[1]
    calibration, visible = motions_alone(sweeps.of_session(track.outcomes[0].session)), SweepLimits()
    if tilts(model, values, np.zeros((1, len(track.cell.joints))))[0] > visible.tilt:
        # Fringes were seen wherever the calibration stood.
        stood = tilts(model, values, np.vstack([calibration.q_start, calibration.q_end]))
        visible = replace(visible, tilt=float(stood.max()))
    motion = partial(visible.within_envelope, model, known)
    return Policy.of(track.drift, model, goal, costs, calibration, motion), forecast, state, known


def suggest_sweeps(track: Track, sweeps: Sweeps, goal: Goal, costs: Costs, now_h: float, n: int) -> Sweeps:
    """At most `n` sweeps that tell most about the tasks now, due or not, best first; `InputError` as `decide_track`."""
    if not track.lasting_trust.usable:
        raise InputError(f"the estimate is not to be used: {track.lasting_trust.against}")
    policy, forecast, state, known = _standing(track, sweeps, goal, costs, now_h)
    chosen = policy.choose(forecast, state, n)
    require_within_envelope(policy.model, known, chosen.q_start, chosen.q_end, file="suggested sweeps")
    return chosen


def decide_track(track: Track, sweeps: Sweeps, goal: Goal, costs: Costs, now_h: float) -> Decision:
    """What to do now with a cell that was followed up to its last session.

    `sweeps` are those of all sessions; the first is the calibration that would be made again. `now_h` is in hours since
    the campaign began. `InputError` if it lies before the last session, a task cannot be driven, or the sweeps may
    leave the cell's envelope.
    """
    policy, forecast, state, known = _standing(track, sweeps, goal, costs, now_h)
    due = track.calibration_due
    reason = f"the robot itself moved before session {due}" if due is not None else track.lasting_trust.against or None
    diagnosed = None if costs.diagnosis_h is None else last_diagnosis(track, sweeps, policy.limits)
    decision = policy.decide(forecast, state, reason, diagnosed)
    again = any(outcome.dof >= len(track.drift.parameters) for outcome in track.outcomes[1:])
    if decision.action == "full" and again and not track.outcomes[0].trust.usable:
        text = f"{reason}; calibrations that follow do not lift that: begin a new campaign with the last one"
        held = replace(decision, action="hold", hold_hours=costs.horizon_h, sweeps=None, after=decision.now)
        return replace(held, minutes=0.0, then_hours=0.0, reason=text)
    if decision.sweeps is not None:
        planned, file = decision.sweeps, f"sweeps of the {decision.action} session"
        require_within_envelope(policy.model, known, planned.q_start, planned.q_end, file=file)
    return decision


def valid_until(track: Track, goal: Goal) -> float:
    """Hours since the campaign began until which the last estimate holds the tasks; a week ahead at most."""
    state = track.last.state
    return state.time_h + last_forecast(track, goal).hold_hours(state, HOURS_PER_WEEK)


def _plain(sweeps: Sweeps) -> Sweeps:
    plan = as_plan(sweeps, session="next", time_h=0.0, file=sweeps.file)
    return replace(plan, group=np.full(len(plan), ""))
