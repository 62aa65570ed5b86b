"""When to measure again: simulated weeks under several policies, share of time in tolerance against sweeps spent.

Each week starts with a full calibration and drifts as the cell's sizes say. The controller drives each task with the
latest estimate; the error is looked at every six minutes. All policies see the same weeks and the same filter.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from fpcal_bayes.study.base import Floats, Results, Study, Summary
from fpcal_bayes.study.policy_rules import MakeRule, rules
from fpcal_bayes.study.policy_week import HOURS, Setting, follow, simulate_week
from fpcal_bayes.track.horizon import Goal

#: Policies that are compared unless others are named.
DEFAULT_POLICIES = ("never", "69 sweeps every 8 h", "q3 and q1 every 1 h", "q3 and q1 every 2 h", "ours, level 0.1")


@dataclass(frozen=True, kw_only=True)
class Policies(Study):
    """The comparison of policies.

    Attributes
    ----------
    goal
        What is to be held.
    policies
        Names of `policy_rules.rules`.
    sigma
        Standard deviation of each change of cavity length, in um.
    hours
        Length of a week.
    harder
        Whether the weeks drift otherwise than modelled too.
    """

    name: ClassVar[str] = "policy"

    goal: Goal
    policies: tuple[str, ...] = DEFAULT_POLICIES
    sigma: float = 0.005
    hours: float = HOURS
    harder: bool = False

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the numbers that one replicate gives."""
        n = len(self.policies)
        return {"sweeps": (n,), "sessions": (n,), "in_tolerance": (n, len(self.goal.tasks)), "all_in_tolerance": (n,)}

    def settings(self) -> dict[str, Any]:
        """Goal, policies, noise and weeks."""
        goal = self.goal
        wanted = {"tolerance_um": goal.tolerance, "tasks": list(goal.tasks), "radius_um": goal.radius}
        weeks = {"sigma_um": self.sigma, "hours": self.hours, "harder": self.harder}
        return wanted | weeks | {"policies": list(self.policies)}

    def replicate(self, number: int) -> dict[str, Floats]:
        """Sweeps and sessions of each policy, and its shares of the time in tolerance, by task and of all at once."""
        setting = Setting(self.cell, self.sigma, self.hours)
        week = simulate_week(setting, self.seed, number, harder=self.harder)
        known = self._known(setting)
        result = {name: np.full(shape, np.nan) for name, shape in self.shapes().items()}
        for i, name in enumerate(self.policies):
            run = follow(setting, week, known[name](), self.goal.tasks)
            within = run.errors <= 1e3 * self.goal.tolerance
            result["sweeps"][i] = sum(run.sweeps)
            result["sessions"][i] = len(run.times)
            result["in_tolerance"][i] = within.mean(axis=1)
            result["all_in_tolerance"][i] = within.all(axis=0).mean()
        return result

    def _known(self, setting: Setting) -> dict[str, MakeRule]:
        return rules(setting, self.goal)

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
        nm = 1e3 * self.goal.tolerance
        return Summary(f"share of {n} weeks of {self.hours:g} h within {nm:g} nm peak to peak, in %", rows)
