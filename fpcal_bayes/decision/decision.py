"""Whether to measure now: hold, re-identify with a few sweeps, or calibrate in full."""

from collections.abc import Callable, Sequence
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

#: By which the least tolerance that can be met is rounded up.
_ROUNDING = 1.002
#: Times at which the running cost of a session is compared.
_COST_STEPS = 40


@dataclass(frozen=True)
class Costs:
    """What measuring costs, and how it is done.

    Attributes
    ----------
    minutes_per_sweep, minutes_per_session
        Time that a session takes: for each sweep, and once.
    out_of_tolerance
        Minutes of measuring that an hour out of tolerance is worth, or None: then the goal's level holds.
    least_sweeps, most_sweeps
        Sweeps of a short session. One sweep looks at one direction of the tasks and trusts the drift sizes for the
        others; as many as the tasks have directions (two for a circle) trust them less and cost more.
    sigma_nm
        Standard deviation of each change of cavity length.
    horizon_h
        How far ahead is looked, in hours.
    diagnosis_h
        Longest time between two sessions that can show a change of the robot itself, in hours, or None: no matter.
    diagnosis_sweeps
        Sweeps of such a session.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    minutes_per_sweep: float = 2.0
    minutes_per_session: float = 0.0
    out_of_tolerance: float | None = None
    least_sweeps: int = 1
    most_sweeps: int = 6
    sigma_nm: float = 5.0
    horizon_h: float = 24.0
    diagnosis_h: float | None = None
    diagnosis_sweeps: int = 8

    def __post_init__(self) -> None:
        choices = [value for value in (self.out_of_tolerance, self.diagnosis_h) if value is not None]
        counts = (self.least_sweeps, self.most_sweeps, self.diagnosis_sweeps)
        positive = (self.minutes_per_sweep, self.sigma_nm, self.horizon_h, *choices, *counts)
        if not (np.isfinite(positive).all() and min(positive) > 0 and 0 <= self.minutes_per_session < np.inf):
            raise InputError("costs: expected times, sigma, horizon and number of sweeps above zero")
        if self.least_sweeps > self.most_sweeps:
            raise InputError(f"costs: at least {self.least_sweeps} sweeps, expected no more than {self.most_sweeps}")

    @property
    def sigma_um(self) -> float:
        """The standard deviation as the filter has it."""
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
    """A session that may be measured now."""

    sweeps: Sweeps
    minutes: float
    state: State
    outlook: TaskForecast
    hours: float


def expected_after(forecast: Forecaster, model: CavityModel, state: State, plan: Sweeps, sigma: float) -> State:
    """The state expected after measuring a plan at the time of `state`, to first order.

    Measurements in the plan are not looked at; `sigma` is the standard deviation of each change of cavity length, in
    um. The mean is that of the prediction, which the estimate of the controller follows.
    """
    planned = seen_by_all(plan, model.cell)
    planned = planned.with_measurement(np.zeros(len(planned)), sigma)
    measurement = SweepMeasurement.of(forecast.drift, model, planned, state.mean)
    misfit, jacobian = measurement.linearise(state.mean)
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
    few sweeps that bring it below the level, the one is recommended that costs the fewest minutes an hour held, the
    sessions that follow it included; if none does, a full calibration.

    The forecast is for the estimate that the controller holds, and `state` predicted for now. `calibration` is the plan
    of a full one; `calibration_due` says why it is due whatever the error, or is None. With `measure` something is
    measured in any case, so that the question is only what; on a machine then what helps most, out of reach or not,
    elsewhere `InputError` if the tolerance is out of reach.
    """
    now = forecast.outlook(state)
    at_horizon = forecast.outlook(forecast.ahead(state, costs.horizon_h))
    sessions: list[_Session] = []
    if costs.out_of_tolerance is not None:
        sessions = _sessions(forecast, model, state, costs, choose)
        forecast = _with_level_of_cost(forecast, sessions, costs)
    goal = forecast.goal

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
        sessions = sessions or _sessions(forecast, model, state, costs, choose)
        able = [s for s in sessions if s.outlook.exceeds(goal.tolerance_um) <= goal.level]
        if able:
            # A session that holds for less than a minute is no better than one that holds for a minute.
            best = min(able, key=lambda s: s.minutes / max(s.hours, 1.0 / 60.0))
            best = _if_it_lasts(forecast, model, costs, choose, best, max(able, key=lambda s: s.hours))
            reason = f"{passes} is {now.exceeds(goal.tolerance_um):.0%} now, {goal.level:.0%} is accepted"
            return made("extrinsic", 0.0, best, best.outlook, reason)
    full = _session(forecast, model, state, costs, calibration)
    if full.outlook.exceeds(goal.tolerance_um) > goal.level:
        every = [full, *sessions]
        best = min(every, key=lambda s: s.outlook.attainable(goal.level))
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


def measure_instead(
    decision: Decision,
    forecast: Forecaster,
    model: CavityModel,
    state: State,
    costs: Costs,
    sweeps: Sweeps,
    reason: str,
) -> Decision:
    """The decision to look at the robot now by other sweeps; arguments as in `decide`."""
    taken = _session(forecast, model, state, costs, sweeps)
    return replace(
        decision,
        action="extrinsic",
        purpose="robot" if decision.sweeps is None or not len(decision.sweeps) else "both",
        hold_hours=0.0,
        sweeps=sweeps,
        minutes=taken.minutes,
        then_hours=taken.hours,
        after=taken.outlook,
        reason=reason,
    )


def _session(forecast: Forecaster, model: CavityModel, state: State, costs: Costs, plan: Sweeps) -> _Session:
    after = expected_after(forecast, model, state, plan, costs.sigma_um)
    updated = forecast.following(after.mean)
    hours = updated.hold_hours(after, costs.horizon_h)
    return _Session(plan, costs.minutes(len(plan)), after, updated.outlook(after), hours)


def _sessions(forecast: Forecaster, model: CavityModel, state: State, costs: Costs, choose: Chooser) -> list[_Session]:
    """Sessions of the fewest sweeps, of one more, and so on."""
    chosen = choose(forecast, state, costs.most_sweeps)
    counts = range(min(costs.least_sweeps, len(chosen)), len(chosen) + 1)
    return [_session(forecast, model, state, costs, chosen.take(np.arange(n))) for n in counts]


def _if_it_lasts(
    forecast: Forecaster, model: CavityModel, costs: Costs, choose: Chooser, short: _Session, long: _Session
) -> _Session:
    """The longer of two sessions where its further sweeps pay in the sessions that follow.

    What a short session leaves out grows, and each short session holds for less time than the one before, by `loss`
    hours. One long session in k, the first of which holds for T hours, holds for k T - loss k (k - 1) / 2 hours at the
    price of k + share short ones; that is best for the k below (marginal value theorem, Charnov 1976).
    """
    if long.hours <= short.hours or short.hours <= 0.0 or short.hours >= costs.horizon_h:
        return short
    later = forecast.ahead(short.state, short.hours)
    again = _session(forecast, model, later, costs, choose(forecast, later, len(short.sweeps)))
    loss = short.hours - again.hours
    if loss <= 0.0:
        return short
    share = (long.minutes - short.minutes) / short.minutes
    between = np.sqrt(share**2 + share + 2.0 * share * long.hours / loss) - share
    return long if long.hours - short.hours >= loss * between else short


def _with_level_of_cost(forecast: Forecaster, sessions: Sequence[_Session], costs: Costs) -> Forecaster:
    """The forecast with the level at which measuring costs least in the long run.

    A session of m minutes is followed by T hours in which an hour out of tolerance costs c minutes. The cost an hour,
    (m + c * integral of p) / T, is least where p(T) is that cost over c (age replacement, Barlow & Proschan 1965).
    """
    cost = costs.out_of_tolerance
    assert cost is not None
    hours = np.geomspace(costs.horizon_h / 500.0, costs.horizon_h, _COST_STEPS)
    best = (np.inf, forecast.goal.level)
    for session in sessions:
        updated = forecast.following(session.state.mean)
        p = np.array([updated.exceeds(session.state, float(h)) for h in hours])
        outside = np.concatenate([[0.0], np.cumsum(np.diff(hours) * (p[1:] + p[:-1]) / 2.0)])
        rate = (session.minutes + cost * outside) / hours
        at = int(np.argmin(rate))
        best = min(best, (float(rate[at]), float(p[at])))
    level = float(np.clip(best[1], 1e-3, 0.999))
    return replace(forecast, goal=replace(forecast.goal, level=level))
