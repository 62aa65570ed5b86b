"""When to measure again: simulated weeks under several policies, share of time in tolerance against sweeps spent.

Each week starts with a full calibration and drifts as the cell's sizes say. The controller drives each task with the
latest estimate; the error is looked at every six minutes. All policies see the same weeks and the same filter.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Forecaster, Goal
from fpcal_bayes.decision.policy import Policy
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.motion.tasks import default_radius, task_path
from fpcal_bayes.study.base import Results, Study, Summary
from fpcal_bayes.study.drifting_week import HOURS, STEP, DriftingWeek, Rule, Setting, follow, simulate_week
from fpcal_bayes.tracking.drift import State
from fpcal_bayes.tracking.session import SessionOutcome

#: Makes a rule anew for each week: some remember what they saw.
MakeRule = Callable[[], Rule]


def translations(cell_joints: int, *joints: int) -> Sweeps:
    """Translations of some joints (1 for ``q1``) over 300 um, the others at zero."""
    start = np.zeros((len(joints), cell_joints))
    start[range(len(joints)), [j - 1 for j in joints]] = -150.0
    return Sweeps.of_um_rad(start, -start, label=[f"q{j}" for j in joints])


def fixed(hours: float, plan: Sweeps) -> Rule:
    """The same sweeps at a fixed interval."""
    return lambda outcome, now, week: (hours, plan)


def never(setting: Setting) -> Rule:
    """No measurement after the calibration."""
    return lambda outcome, now, week: (setting.hours * 2, None)


def check_circle(setting: Setting, hours: float, tolerance: float, plan: Sweeps) -> Rule:
    """Drive a circle at a fixed interval, and measure when its peak to peak exceeds `tolerance` (um).

    The circle counts as no sweep.
    """

    def rule(outcome: SessionOutcome, now: float, week: DriftingWeek) -> tuple[float, Sweeps | None]:
        values = setting.drift.values(outcome.state.mean)
        task = task_path(setting.cell, setting.model.vector(values), "circle")
        ahead = min(now + hours, setting.hours)
        error = float(peak_to_peak(task_errors(setting.model, week.at(ahead), values, task))[0])
        return hours, plan if error > tolerance else None

    return rule


def ours(setting: Setting, goal: Goal, costs: Costs, fixed_hours: float | None = None) -> Rule:
    """The policy; with `fixed_hours` only its choice of sweeps, at a fixed interval."""
    drift, model = setting.drift, setting.model
    policy = Policy.of(drift, model, goal, costs, setting.paper)
    diagnosed = 0.0

    def rule(outcome: SessionOutcome, now: float, week: DriftingWeek) -> tuple[float, Sweeps | None]:
        nonlocal diagnosed
        if now == 0.0 or outcome.dof >= costs.diagnosis_sweeps:
            diagnosed = now
        forecast = Forecaster.of(drift, model, goal, outcome.state.mean)
        state: State = forecast.ahead(outcome.state, now - outcome.state.time_h)
        if fixed_hours is not None:
            return fixed_hours, policy.choose(forecast, forecast.ahead(state, fixed_hours), costs.most_sweeps)
        due = "the robot moved" if outcome.verdict == "intrinsics-moved" else None
        # The session is planned for the last step that ends in tolerance.
        wait = STEP if due else max(STEP, forecast.hold_hours(state, costs.horizon_h))
        at_session = forecast.ahead(state, wait + 2.0 / 60.0)
        return wait, policy.decide(forecast, at_session, due, diagnosed).sweeps

    return rule


def rules(setting: Setting, goal: Goal) -> dict[str, MakeRule]:
    """All rules by name; `goal` is what is to be held, each of the policies having its own level."""
    two = translations(len(setting.cell.joints), 3, 1)
    found: dict[str, MakeRule] = {
        "never": lambda: never(setting),
        "69 sweeps every 8 h": lambda: fixed(8.0, setting.paper),
    }
    for hours in (0.5, 0.7, 1.0, 1.3, 2.0, 4.0):
        found[f"q3 and q1 every {hours:g} h"] = lambda hours=hours: fixed(hours, two)  # type: ignore[misc]
    found["q3 and q1 when a circle every 0.5 h fails"] = lambda: check_circle(setting, 0.5, goal.tolerance_um, two)
    for count, intervals in ((1, (0.5, 0.7, 1.0, 1.3)), (2, (1.0, 1.3, 2.0, 4.0))):
        for hours in intervals:
            found[f"{count} chosen every {hours:g} h"] = lambda count=count, hours=hours: ours(  # type: ignore[misc]
                setting, goal, Costs(most_sweeps=count), hours
            )
    for level in (0.05, 0.1, 0.15, 0.2):
        found[f"ours, level {level:g}"] = lambda level=level: ours(  # type: ignore[misc]
            setting, replace(goal, level=level), Costs(most_sweeps=2)
        )
    return found


#: Policies that are compared unless others are named.
DEFAULT_POLICIES = ("never", "69 sweeps every 8 h", "q3 and q1 every 1 h", "q3 and q1 every 2 h", "ours, level 0.1")


@dataclass(frozen=True, kw_only=True)
class Policies(Study):
    """The comparison of policies."""

    name: ClassVar[str] = "policy"

    goal: Goal  # what is to be held
    policies: tuple[str, ...] = DEFAULT_POLICIES  # names of `rules`
    sigma: float = 0.005  # standard deviation of each change of cavity length, in um
    hours: float = HOURS  # length of a week
    harder: bool = False  # whether the weeks drift otherwise than modelled too

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the numbers that one replicate gives."""
        n = len(self.policies)
        return {"sweeps": (n,), "sessions": (n,), "in_tolerance": (n, len(self.goal.tasks)), "all_in_tolerance": (n,)}

    def settings(self) -> dict[str, Any]:
        """Goal, policies, noise and weeks."""
        goal = self.goal
        radius = default_radius(self.cell) if goal.radius_um is None else goal.radius_um
        wanted = {"tolerance_um": goal.tolerance_um, "tasks": list(goal.tasks), "radius_um": radius}
        weeks = {"sigma_um": self.sigma, "hours": self.hours, "harder": self.harder}
        return wanted | weeks | {"policies": list(self.policies)}

    def replicate(self, number: int) -> dict[str, Floats]:
        """Sweeps and sessions of each policy, and its shares of the time in tolerance, by task and of all at once."""
        setting = Setting(self.cell, self.sigma, self.hours)
        week = simulate_week(setting, self.seed, number, harder=self.harder)
        known = rules(setting, self.goal)
        result = {name: np.full(shape, np.nan) for name, shape in self.shapes().items()}
        for i, name in enumerate(self.policies):
            run = follow(setting, week, known[name](), self.goal.tasks)
            within = run.errors <= 1e3 * self.goal.tolerance_um
            result["sweeps"][i] = sum(run.sweeps)
            result["sessions"][i] = len(run.times)
            result["in_tolerance"][i] = within.mean(axis=1)
            result["all_in_tolerance"][i] = within.all(axis=0).mean()
        return result

    def summary(self, results: Results) -> Summary:
        """Means over the weeks with their standard errors."""
        n = len(results["sweeps"])
        rows: list[dict[str, str | int | float]] = []
        for i, name in enumerate(self.policies):
            row: dict[str, str | int | float] = {"policy": name, "sweeps": float(results["sweeps"][:, i].mean())}
            row["sessions"] = float(results["sessions"][:, i].mean())
            for j, task in enumerate(self.goal.tasks):
                row[f"{task}_percent"] = 100.0 * float(results["in_tolerance"][:, i, j].mean())
            every = results["all_in_tolerance"][:, i]
            row["all_percent"] = 100.0 * float(every.mean())
            row["standard_error"] = 100.0 * float(every.std(ddof=1)) / np.sqrt(n) if n > 1 else 0.0
            rows.append(row)
        nm = 1e3 * self.goal.tolerance_um
        return Summary(f"share of {n} weeks of {self.hours:g} h within {nm:g} nm peak to peak, in %", rows)
