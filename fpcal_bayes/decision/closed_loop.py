"""The closed loop: a rule or a policy says when to measure what, and the filter takes in what was measured.

The cell is behind a function that measures a plan, simulated or real. How well the robot did meanwhile is judged
afterwards, by the estimates that the controller held and a truth that is known in simulation only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.decision import Decision
from fpcal_bayes.decision.diagnosis import is_diagnosis
from fpcal_bayes.decision.forecast import Forecaster
from fpcal_bayes.decision.policy import Policy
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.tracking.alarms import ROBOT_MOVED, Limits
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.session import SessionOutcome, followed_drift, take_in
from fpcal_bayes.tracking.smoother import looked_at_again

#: Measures a plan at a time in hours.
Measure = Callable[[Sweeps, float], Sweeps]
#: Which sweeps are measured at a time in hours (none: only look again).
Plan = Callable[[float], Sweeps | None]

#: Sessions of a policy begin on multiples of this, in hours.
STEP_H = 0.05


@dataclass(frozen=True)
class Sessions:
    """What was measured so far: outcomes, the calibration first, and the sweeps of each session after it."""

    outcomes: list[SessionOutcome]
    sweeps: list[Sweeps]


#: What comes next: after the sessions so far and at a time, hours until something is measured, and what then.
Rule = Callable[[Sessions, float], tuple[float, Plan]]


@dataclass(frozen=True)
class ClosedLoop:
    """What a policy did."""

    outcomes: tuple[SessionOutcome, ...]  # one per session, the calibration first
    sweeps: tuple[Sweeps, ...]  # measured, one set a session after the calibration
    decisions: tuple[Decision, ...]  # that ordered each of these sessions


def run_rule(
    rule: Rule,
    drift: DriftModel,
    model: CavityModel,
    limits: Limits,
    start: SessionOutcome,
    measure: Measure,
    end_h: float,
    *,
    step_h: float,
) -> Sessions:
    """Let a rule say when to measure what, from a calibration until `end_h`, and take in what is measured.

    Sessions begin on multiples of `step_h`, at most one on each. The drift is that of the filter (`followed_drift`).
    """
    done, now = Sessions([start], []), start.time_h
    while True:
        hours, plan_at = rule(done, now)
        now = float((np.floor(now / step_h + 1e-6) + max(1.0, np.floor(hours / step_h + 1e-6))) * step_h)
        if now > end_h + 1e-9:
            return done
        plan = plan_at(now)
        if plan is None:
            continue
        taken, last = measure(plan, now), done.outcomes[-1]
        done.outcomes.append(take_in(drift, model, limits, last.state, last.monitor, taken))
        done.outcomes[-1] = looked_at_again(drift, done.outcomes)
        done.sweeps.append(taken)


def run_policy(policy: Policy, start: SessionOutcome, measure: Measure, end_h: float) -> ClosedLoop:
    """Let a policy run from a calibration until the last session that may begin by `end_h`.

    Each session is planned for the last step at which the tolerance is still expected to hold; `InputError` if the
    tolerance cannot be met.
    """
    drift, model, limits = followed_drift(policy.drift, policy.model, start), policy.model, policy.limits
    policy = replace(policy, drift=drift)
    decisions: list[Decision] = []
    diagnosed = start.time_h

    def rule(done: Sessions, now: float) -> tuple[float, Plan]:
        nonlocal diagnosed
        last = done.outcomes[-1]
        if done.sweeps and is_diagnosis(drift, model, done.outcomes[-2], last, done.sweeps[-1], limits):
            diagnosed = now
        forecast = Forecaster.of(drift, model, policy.goal, last.state.mean)
        due = f"the robot itself moved before session {last.session}" if last.verdict in ROBOT_MOVED else None
        state = forecast.ahead(last.state, now - last.time_h)

        def plan_at(time_h: float) -> Sweeps:
            at_session = forecast.ahead(last.state, time_h - last.time_h)
            decisions.append(policy.measure_now(forecast, at_session, due, diagnosed))
            sweeps = decisions[-1].sweeps
            assert sweeps is not None
            return sweeps

        # A session too many is dearer than one a few minutes late: it is planned for the end of the hold.
        return 0.0 if due else policy.hold_hours(forecast, state, diagnosed), plan_at

    done = run_rule(rule, drift, model, limits, start, measure, end_h, step_h=STEP_H)
    return ClosedLoop(tuple(done.outcomes), tuple(done.sweeps), tuple(decisions))


def task_peaks(
    model: CavityModel,
    truth: Truth,
    held: Sequence[tuple[float, Floats]],
    tasks: Sequence[str],
    times_h: Floats,
    *,
    radius: float | None = None,
    whole: bool = False,
) -> Floats:
    """Peak to peak of the error of tasks while a controller holds one estimate after the other, in um, (n_tasks, t).

    `held` says from when on which free parameters (n_free,), in um and rad, were held; `times_h` (t,) where to look.
    With `whole` the paths are taken in full, beyond joint limits too.
    """
    columns = truth.parameters.positions(model.free.names)
    peaks = np.zeros((len(tasks), len(times_h)))
    number = np.searchsorted(np.array([time for time, _ in held]), times_h + 1e-9) - 1
    for i in np.unique(number):
        here = number == i
        values = held[i][1]
        true = truth.at(times_h[here])[:, columns]
        for row, name in enumerate(tasks):
            task = find_task(model.cell, model.vector(values), name, radius=radius)
            peaks[row, here] = peak_to_peak(task_errors(model, true, values, task if whole else task.driven()))
    return peaks
