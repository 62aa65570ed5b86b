"""When to measure again: simulated weeks under several policies, share of time in tolerance against sweeps spent.

Each week starts with a full calibration. It drifts as the
cell's sizes say, or is harder (`--harder`): a day and night cycle of temperature that moves mirror and fibre, two
knocks, a steady rate of one parameter, and one quiet day. The temperature is logged, so that the filter allows for its
part and for steady rates, whose sizes it does not know (`likely_terms`); `--stated` leaves them out. The controller
drives each task with the latest estimate; the error is looked at every six minutes. All policies see the same weeks and
the same filter.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from drifting_week import STEP, DriftingWeek, Rule, Run, Setting, follow, simulate_week

from fpcal_bayes.core import write_json
from fpcal_bayes.decision import Costs, Forecaster, Goal, Policy, is_diagnosis
from fpcal_bayes.infer import peak_to_peak, task_errors
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps
from fpcal_bayes.motion import task_path
from fpcal_bayes.tracking import DriftModel, SessionOutcome

CELL = load_cell(mechanics="none")


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


def chosen(setting: Setting, goal: Goal, costs: Costs, hours: float) -> Rule:
    """The policy's choice of sweeps, at a fixed interval."""
    policy = Policy.of(setting.drift, setting.model, goal, costs, setting.paper)

    def rule(outcome: SessionOutcome, now: float, week: DriftingWeek) -> tuple[float, Sweeps | None]:
        forecast = Forecaster.of(setting.drift, setting.model, goal, outcome.state.mean)
        state = forecast.ahead(outcome.state, now - outcome.state.time_h)
        return hours, policy.choose(forecast, forecast.ahead(state, hours), costs.most_sweeps)

    return rule


@dataclass(frozen=True)
class AsStated(Setting):
    """The filter knows of the cell's own terms only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "drift", DriftModel.of(self.cell))


def fixed_at_task(setting: Setting, hours: float) -> Rule:
    """Both translations at a fixed interval, made at the aligned pose of the estimate."""
    two = translations(len(CELL.joints), 3, 1)
    moved = two.q_start != two.q_end

    def rule(outcome: SessionOutcome, now: float, week: DriftingWeek) -> tuple[float, Sweeps]:
        vector = setting.model.vector(setting.drift.values(outcome.state.mean))
        pose = task_path(CELL, vector, "circle", n_points=5).start
        ends = (np.where(moved, end, pose) for end in (two.q_start, two.q_end))
        return hours, Sweeps.of_um_rad(*ends, label=two.label)

    return rule


def planned(setting: Setting, goal: Goal, costs: Costs) -> Rule:
    """The policy: a session at the last step of the hold, and what to measure decided for that time."""
    policy = Policy.of(setting.drift, setting.model, goal, costs, setting.paper)
    before: SessionOutcome | None = None
    plan: Sweeps | None = None
    diagnosed = 0.0

    def rule(outcome: SessionOutcome, now: float, week: DriftingWeek) -> tuple[float, Sweeps | None]:
        nonlocal before, plan, diagnosed
        if costs.diagnosis_h and before is not None and plan is not None:
            taken = plan.with_measurement(np.zeros(len(plan)), np.full(len(plan), setting.sigma))
            if is_diagnosis(policy.drift, setting.model, before, outcome, taken, policy.limits):
                diagnosed = outcome.time_h
        forecast = Forecaster.of(policy.drift, setting.model, goal, outcome.state.mean)
        due = "the robot moved" if outcome.verdict == "intrinsics-moved" else None
        wait = 0.0 if due else policy.hold_hours(forecast, outcome.state, diagnosed)
        # `follow` begins sessions on a step.
        at = (np.floor(now / STEP + 1e-6) + max(1, np.floor(wait / STEP + 1e-6))) * STEP
        before, plan = outcome, None
        if at <= setting.hours - STEP / 2.0:
            state = forecast.ahead(outcome.state, at - outcome.time_h)
            plan = policy.measure_now(forecast, state, due, diagnosed).sweeps
        return wait, plan

    return rule


def rules(options: argparse.Namespace, setting: Setting) -> dict[str, MakeRule]:
    """All policies by name."""
    goal, two = Goal(options.tolerance, tuple(options.tasks)), translations(len(CELL.joints), 3, 1)
    found: dict[str, MakeRule] = {
        "never": lambda: never(setting),
        "69 sweeps every 8 h": lambda: fixed(8.0, setting.paper),
    }
    for hours in (0.7, 1.0, 1.5, 2.0, 4.0):
        found[f"q3 and q1 at joint zero every {hours:g} h"] = lambda hours=hours: fixed(hours, two)
    for hours in (0.7, 1.0, 1.3, 1.6, 2.0, 4.0):
        found[f"q3 and q1 at the task every {hours:g} h"] = lambda hours=hours: fixed_at_task(setting, hours)
    found["q3 and q1 when a circle every 0.5 h fails"] = lambda: check_circle(setting, 0.5, goal.tolerance_um, two)
    most = Costs(most_sweeps=options.most)
    for hours in options.chosen:
        found[f"{options.most} chosen every {hours:g} h"] = lambda hours=hours: chosen(setting, goal, most, hours)
    costs = Costs(least_sweeps=options.least, most_sweeps=options.most, diagnosis_h=options.diagnose)
    for level in options.levels:
        found[f"ours, level {level:g}"] = lambda level=level: planned(setting, replace(goal, level=level), costs)
    return {name: rule for name, rule in found.items() if any(text in name for text in options.only)}


def figures(runs: list[Run], tasks: tuple[str, ...], tolerance: float) -> dict[str, float | int]:
    """Sweeps, sessions, time a decision takes, and the share of time in tolerance in %, by task and of all at once."""
    weeks, sessions = len(runs), sum(len(run.times) for run in runs)
    within = np.array([run.errors <= tolerance for run in runs])
    found: dict[str, float | int] = {
        "weeks": weeks,
        "sweeps": float(np.mean([sum(run.sweeps) for run in runs])),
        "most": max(sum(run.sweeps) for run in runs),
        "sessions": sessions / weeks,
        "decision_ms": 1e3 * sum(run.decision_s for run in runs) / max(1, sessions),
    }
    shares = {name: within[:, row].mean(axis=1) for row, name in enumerate(tasks)}
    for name, share in {**shares, "all": within.all(axis=1).mean(axis=1)}.items():
        found[name] = 100.0 * float(share.mean())
        found[f"{name}_error"] = 100.0 * float(share.std()) / weeks**0.5
    return found


def report(name: str, found: dict[str, float | int], tasks: tuple[str, ...]) -> str:
    """One line: sweeps, sessions, shares in tolerance with standard errors over the weeks, time a decision takes."""
    shares = " ".join(f"{found[task]:7.2f} ({found[f'{task}_error']:.2f})" for task in (*tasks, "all"))
    return (
        f"{name:44s} {found['sweeps']:7.1f} (most {found['most']:4d}) {found['sessions']:6.1f} {shares} "
        f"{found['decision_ms']:6.1f}"
    )


def parser() -> argparse.ArgumentParser:
    """The options of the study."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("--weeks", type=int, default=20)
    made.add_argument("--first", type=int, default=0, help="number of the first week")
    made.add_argument("--tolerance", type=float, default=50.0, help="peak to peak, in nm")
    made.add_argument("--tasks", nargs="+", default=["circle"])
    made.add_argument("--levels", type=float, nargs="+", default=[0.15])
    made.add_argument("--least", type=int, default=1, help="sweeps of a session of ours, at least")
    made.add_argument("--most", type=int, default=2, help="sweeps of a session of ours, at most")
    made.add_argument("--chosen", type=float, nargs="*", default=[], help="intervals at which ours only chooses")
    made.add_argument("--diagnose", type=float, help="hours between looks at the robot itself (default: none)")
    made.add_argument("--harder", action="store_true", help="weeks that do not drift as modelled")
    made.add_argument("--stated", action="store_true", help="the filter knows of random walks only")
    made.add_argument("--json", type=Path, help="file for the figures of the table")
    made.add_argument("--only", nargs="+", default=[""], help="policies whose name holds one of these texts")
    return made


def main() -> None:
    """Print the figures."""
    options = parser().parse_args()
    began = time.perf_counter()
    numbers = range(options.first, options.first + options.weeks)
    setting = AsStated(CELL) if options.stated else Setting(CELL)
    weeks = [simulate_week(setting, seed, harder=options.harder) for seed in numbers]
    print(f"{len(weeks)} weeks; tasks {', '.join(options.tasks)}; tolerance {options.tolerance:g} nm peak to peak")
    tasks = tuple(options.tasks)
    print(
        f"{'policy':44s}  sweeps             sessions  {' %, '.join((*tasks, 'all'))} % (standard error)  ms a session"
    )
    results = {}
    for name, make in rules(options, setting).items():
        runs = [follow(setting, week, make(), tasks) for week in weeks]
        results[name] = figures(runs, tasks, options.tolerance)
        print(report(name, results[name], tasks), flush=True)
        if options.json is not None:
            about = {"tasks": tasks, "tolerance_nm": options.tolerance, "harder": options.harder}
            write_json(options.json, about | {"policies": results})
    print(f"{time.perf_counter() - began:.0f} s, {time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
