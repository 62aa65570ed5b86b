"""Whether to measure now: hold, re-identify with a few sweeps, or calibrate in full."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.decision.forecast import Forecaster, TaskForecast
from fpcal_bayes.measure.protocol import seen_by_all
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.drift import State
from fpcal_bayes.tracking.filter import Innovation
from fpcal_bayes.tracking.measurement import SweepMeasurement

Action = Literal["hold", "extrinsic", "full"]
Purpose = Literal["extrinsics", "robot", "both"]
#: Sweeps for a state at the time of the session, at most so many, the most useful first.
Chooser = Callable[[Forecaster, State, int], Sweeps]

#: So many sessions in a row are looked ahead where one is not enough.
_IN_A_ROW = 5
#: By which the least tolerance that can be met is rounded up.
_ROUNDING = 1.002


@dataclass(frozen=True)
class Costs:
    """What measuring costs, and how it is done; `InputError` where a number is out of its range."""

    # time that a session takes: for each sweep, and once
    minutes_per_sweep: float = 2.0
    minutes_per_session: float = 0.0
    # Sweeps of a short session. One sweep looks at one direction of the tasks and trusts the drift sizes for the
    # others; as many as the tasks have directions (two for a circle) trust them less and cost more.
    least_sweeps: int = 1
    most_sweeps: int = 6
    sigma_nm: float = 5.0  # standard deviation of each change of cavity length
    horizon_h: float = 24.0  # how far ahead is looked
    diagnosis_h: float | None = None  # longest time between two sessions that can show a change of the robot itself
    diagnosis_sweeps: int = 8  # of such a session

    def __post_init__(self) -> None:
        counts = (self.least_sweeps, self.most_sweeps, self.diagnosis_sweeps)
        diagnosis_h = 1.0 if self.diagnosis_h is None else self.diagnosis_h
        positive = (self.minutes_per_sweep, self.sigma_nm, self.horizon_h, diagnosis_h, *counts)
        if not (np.isfinite(positive).all() and min(positive) > 0 and 0 <= self.minutes_per_session < np.inf):
            raise InputError("costs: expected times, sigma, horizon and number of sweeps above zero")
        if self.least_sweeps > self.most_sweeps:
            raise InputError(f"costs: at least {self.least_sweeps} sweeps, expected no more than {self.most_sweeps}")

    @property
    def sigma_um(self) -> float:
        """The standard deviation in um."""
        return 1e-3 * self.sigma_nm

    def minutes(self, n_sweeps: int) -> float:
        """How long a session of so many sweeps takes."""
        return self.minutes_per_session + n_sweeps * self.minutes_per_sweep


@dataclass(frozen=True)
class Decision:
    """What to do, and what follows from it."""

    # ``hold``: measure nothing before `hold_hours` have passed; ``extrinsic``: measure `sweeps` now; ``full``:
    # calibrate in full now
    action: Action
    now_h: float  # time of the decision in hours since the campaign began
    hold_hours: float  # hours from now until something is to be measured; zero if now
    level: float  # probability of being out of tolerance that is accepted
    sweeps: Sweeps | None  # to be measured now; no rows if nothing is
    minutes: float  # how long that takes
    then_hours: float  # hours that the tolerance is expected to hold after it, up to the horizon
    # now, at_horizon, after: error of the tasks now, at the horizon if nothing is measured, and after what is
    # recommended (for ``hold``, at its end)
    now: TaskForecast
    at_horizon: TaskForecast
    after: TaskForecast
    reason: str
    #: What the sweeps are for: ``extrinsics`` (mirror and fibre), ``robot`` (to look whether it changed), or ``both``.
    purpose: Purpose = "extrinsics"
    #: The least tolerance that can be met, in nm, where the goal's is below it: then nothing is asked for but a full
    #: calibration of a robot that moved; else None.
    attainable_nm: float | None = None

    def __repr__(self) -> str:
        sweeps = "" if self.sweeps is None else f", {counted(len(self.sweeps), 'sweep')}"
        return f"Decision({self.action}{sweeps}, look again in {self.hold_hours:.3g} h: {self.reason})"


@dataclass(frozen=True)
class _Session:
    sweeps: Sweeps
    minutes: float
    state: State
    outlook: TaskForecast
    hours: float


def expected_after(forecast: Forecaster, model: CavityModel, state: State, plan: Sweeps, sigma: float) -> State:
    """The state after a plan of rows of `sigma` in um at the time of `state`, to first order; its mean stays."""
    planned = seen_by_all(plan, model.cell)
    planned = planned.with_measurement(np.zeros(len(planned)), sigma)
    misfit, jacobian = SweepMeasurement.of(forecast.drift, model, planned, state.mean).linearise(state.mean)
    innovation = Innovation.of(misfit, jacobian, state.covariance, 0.0)
    seen = innovation.whiten(innovation.jacobian @ state.covariance)
    return replace(state, covariance=state.covariance - seen.T @ seen)


def decide(
    forecast: Forecaster,
    model: CavityModel,
    state: State,
    costs: Costs,
    choose: Chooser,
    calibration: Sweeps,
    calibration_due: str | None = None,
    *,
    measure: bool = False,
) -> Decision:
    """What to do now; where not even a full calibration brings the tasks within the tolerance, hold and say what would.

    Nothing is measured before the probability of being out of tolerance passes the level. Then, of the sessions with
    few sweeps that bring it below, the one that costs the fewest minutes an hour held; if none does, a full one; if
    that does not either, the first of several sessions in a row with few sweeps that do.

    The forecast is for the estimate that the controller holds, and `state` predicted for now. `calibration` is the plan
    of a full one; `calibration_due` says why it is due whatever the error, or is None. With `measure` something is
    measured in any case, so that the question is only what; on a machine then what helps most, out of reach or not,
    elsewhere `InputError` if the tolerance is out of reach.
    """
    now = forecast.outlook(state)
    at_horizon = forecast.outlook(forecast.ahead(state, costs.horizon_h))
    sessions, goal = list[_Session](), forecast.goal

    def made(action: Action, hold: float, taken: _Session | None, after: TaskForecast, reason: str) -> Decision:
        sweeps, minutes, then = (None, 0.0, 0.0) if taken is None else (taken.sweeps, taken.minutes, taken.hours)
        return Decision(
            action, state.time_h, hold, goal.level, sweeps, minutes, then, now, at_horizon, after, reason
        )  # fmt: skip

    passes = f"P(error > {1e3 * goal.tolerance_um:g} nm)"
    if calibration_due is None:
        hold = 0.0 if measure else forecast.hold_hours(state, costs.horizon_h)
        if hold > 0.0:
            after = forecast.outlook(forecast.ahead(state, hold))
            beyond = "stays below" if hold >= costs.horizon_h else "reaches"
            return made("hold", hold, None, after, f"{passes} {beyond} {goal.level:.0%} at the end of this time")
        # Sessions of the fewest sweeps, of one more, and so on.
        chosen = choose(forecast, state, costs.most_sweeps)
        counts = range(min(costs.least_sweeps, len(chosen)), len(chosen) + 1)
        sessions = [session_of(forecast, model, state, costs, chosen.take(np.arange(n))) for n in counts]
        able = [s for s in sessions if s.outlook.exceeds(goal.tolerance_um) <= goal.level]
        if able:
            # A session that holds for less than a minute is no better than one that holds for a minute.
            best = min(able, key=lambda s: s.minutes / max(s.hours, 1.0 / 60.0))
            best = _if_it_lasts(forecast, model, costs, choose, best, max(able, key=lambda s: s.hours))
            reason = f"{passes} is {now.exceeds(goal.tolerance_um):.0%} now, {goal.level:.0%} is accepted"
            return made("extrinsic", 0.0, best, best.outlook, reason)
    full = session_of(forecast, model, state, costs, calibration)
    if full.outlook.exceeds(goal.tolerance_um) > goal.level:
        if sessions and not measure:
            # What remains of a machine's error motions after one session may need others, one right after the other.
            row = [sessions[-1]]
            while len(row) < _IN_A_ROW and row[-1].outlook.exceeds(goal.tolerance_um) > goal.level:
                then = forecast.ahead(row[-1].state, row[-1].minutes / 60.0)
                row.append(session_of(forecast, model, then, costs, choose(forecast, then, costs.most_sweeps)))
            if row[-1].outlook.exceeds(goal.tolerance_um) <= goal.level:
                count = counted(costs.most_sweeps, "sweep")
                reason = f"no session of up to {count} brings {passes} below {goal.level:.0%}, {len(row)} in a row do"
                return made("extrinsic", 0.0, row[0], row[0].outlook, reason)
        best = min([full, *sessions], key=lambda s: s.outlook.attainable(goal.level))
        # Rounded up, and a little more: the forecast for that tolerance leaves out other negligible directions.
        least_nm = 0.1 * float(np.ceil(1e4 * _ROUNDING * best.outlook.attainable(goal.level)))
        text = (
            f"tolerance {1e3 * goal.tolerance_um:g} nm cannot be met for {', '.join(goal.tasks)}: the best that can be "
            f"met with probability {1.0 - goal.level:g} is {least_nm:.1f} nm, right "
            f"after {'a full calibration' if best is full else counted(len(best.sweeps), 'sweep')}"
        )
        if not measure:
            due = calibration_due is not None
            found = made("full", 0.0, full, full.outlook, f"{calibration_due}; {text}") if due else None
            return replace(found or made("hold", 0.0, None, now, text), attainable_nm=least_nm)
        if best is full or forecast.drift.motions is None:
            raise InputError(text)
        # A machine that was within reach before does what it can; no calibration that cannot help.
        return made("extrinsic", 0.0, best, best.outlook, text)
    reason = (
        calibration_due
        or f"no session of up to {counted(costs.most_sweeps, 'sweep')} brings {passes} below {goal.level:.0%}"
    )
    return made("full", 0.0, full, full.outlook, reason)


def session_of(forecast: Forecaster, model: CavityModel, state: State, costs: Costs, plan: Sweeps) -> _Session:
    """What a session of the sweeps of `plan` costs and gives."""
    after = expected_after(forecast, model, state, plan, costs.sigma_um)
    updated = forecast.following(after.mean)
    hours = updated.hold_hours(after, costs.horizon_h)
    return _Session(plan, costs.minutes(len(plan)), after, updated.outlook(after), hours)


def _if_it_lasts(
    forecast: Forecaster, model: CavityModel, costs: Costs, choose: Chooser, short: _Session, long: _Session
) -> _Session:
    """The longer of two sessions where its further sweeps pay in the sessions that follow."""
    # Each short session holds `loss` hours less than the one before. A long one in k, holding T hours, holds for
    # k T - loss k (k - 1) / 2 hours at the price of k + share short ones (marginal value theorem, Charnov 1976).
    if long.hours <= short.hours or short.hours <= 0.0 or short.hours >= costs.horizon_h:
        return short
    later = forecast.ahead(short.state, short.hours)
    loss = short.hours - session_of(forecast, model, later, costs, choose(forecast, later, len(short.sweeps))).hours
    if loss <= 0.0:
        return short
    share = (long.minutes - short.minutes) / short.minutes
    between = np.sqrt(share**2 + share + 2.0 * share * long.hours / loss) - share
    return long if long.hours - short.hours >= loss * between else short
