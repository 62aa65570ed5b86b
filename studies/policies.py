"""When to measure again: simulated weeks under several policies, share of time in tolerance against sweeps spent.

Each week starts with a full calibration and drifts as the cell's sizes say. The controller drives each task with the
latest estimate; the error is looked at every six minutes. All policies see the same weeks and the same filter.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.control.tasks import task_path
from fpcal_bayes.infer.task_error import peak_to_peak, task_errors
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import load_cell
from fpcal_bayes.track.consistency import Limits
from fpcal_bayes.track.decision import Costs
from fpcal_bayes.track.drift import DriftModel
from fpcal_bayes.track.filter import State
from fpcal_bayes.track.horizon import Forecast, Goal
from fpcal_bayes.track.policy import Policy
from fpcal_bayes.track.step import SessionOutcome, take_in
from fpcal_bayes.track.tracker import calibrate

HOURS = 192.0
#: Steps of the truth and of the looks at the error, in hours.
STEP = 0.1
SIGMA = 0.005

CELL = load_cell()
MODEL = CavityModel.of(CELL)
DRIFT = DriftModel.of(CELL)
PAPER = paper_protocol(CELL)
LIMITS = Limits()


@dataclass(frozen=True)
class Week:
    """Truth at every step, and the calibration at its beginning."""

    seed: int
    times: np.ndarray
    values: np.ndarray
    calibration: SessionOutcome

    def at(self, time_h: float) -> np.ndarray:
        """The truth at a time."""
        here: np.ndarray = self.values[min(round(time_h / STEP), len(self.times) - 1)]
        return here


def simulate_week(seed: int, *, harder: bool) -> Week:
    """A week that drifts as modelled, or a harder one that the policies know nothing of.

    The harder week adds a day and night cycle of the mirror's and fibre's angles, two knocks, a steady rate of one
    parameter, and one day on which nothing drifts.
    """
    random = np.random.default_rng([7, seed])
    times = np.arange(round(HOURS / STEP) + 1) * STEP
    steps = DRIFT.walk * DRIFT.scale * np.sqrt(STEP / 24.0) * random.standard_normal((len(times), len(CELL.free)))
    steps[0] = 0.0
    if harder:
        quiet = 24.0 * random.integers(1, 8)
        steps[(times > quiet) & (times <= quiet + 24.0)] = 0.0
        extrinsic_angle = DRIFT.extrinsic & np.array([p.unit == "deg" for p in CELL.free])
        for knock in random.uniform(12.0, HOURS - 12.0, 2):
            size = np.array([np.radians(0.1) if p.unit == "deg" else 20.0 for p in CELL.free])
            steps[int(knock / STEP)] += np.where(DRIFT.extrinsic, size * random.choice([-1.0, 1.0], len(size)), 0.0)
        steady = np.array([p.name == "theta_et" for p in CELL.free])
        steps += np.where(steady, np.radians(0.03) * STEP / 24.0, 0.0)
        cycle = np.sin(2.0 * np.pi * times / 24.0)[:, None] * np.where(extrinsic_angle, np.radians(0.01), 0.0)
        steps += np.diff(cycle, axis=0, prepend=0.0)
    values = paper_truth(CELL).at(0.0) + np.cumsum(steps, axis=0)
    calibration, _, _ = calibrate(CELL, DRIFT, measured(PAPER, 0.0, values[0], seed, 0))
    return Week(seed, times, values, calibration)


def measured(plan: Sweeps, time_h: float, values: np.ndarray, *seed: int) -> Sweeps:
    """The sweeps of a plan, measured at a time."""
    number = int(np.random.default_rng([11, *seed]).integers(2**31))
    count = len(plan)
    timed = replace(plan, session=np.full(count, f"h{time_h:08.2f}"), time_h=np.full(count, time_h))
    truth = Truth(CELL.free, np.array([time_h]), values[None])
    return simulate(CELL, truth, timed, sigma=SIGMA, seed=number)


@dataclass
class Run:
    """One policy through one week: when it measured, how much, and the error in nm at every step, a row a task."""

    times: list[float]
    sweeps: list[int]
    errors: np.ndarray
    decision_s: float = 0.0


#: What is measured next: after how many hours, and which sweeps (none: only look).
Rule = Callable[[SessionOutcome, float, Week], tuple[float, Sweeps | None]]


def follow(week: Week, rule: Rule, tasks: tuple[str, ...]) -> Run:
    """Let a rule say when to measure, take in what it measures, and note the errors of the tasks."""
    outcome, now, spent = week.calibration, 0.0, 0.0
    run = Run([], [], np.zeros((len(tasks), len(week.times))))
    while True:
        began = time.perf_counter()
        wait, plan = rule(outcome, now, week)
        spent += time.perf_counter() - began
        # Sessions begin on a step, and at most one on each.
        until = (np.floor(now / STEP + 1e-6) + max(1, np.floor(wait / STEP + 1e-6))) * STEP
        last = until > HOURS - STEP / 2.0
        here = (week.times > now - STEP / 2) & (week.times < (HOURS + 1 if last else until - STEP / 2))
        values = DRIFT.values(outcome.state.mean)
        for row, name in enumerate(tasks):
            task = task_path(CELL, MODEL.vector(values), name)
            run.errors[row, here] = 1e3 * peak_to_peak(task_errors(MODEL, week.values[here], values, task))
        if last:
            break
        now = until
        if plan is not None:
            sweeps = measured(plan, now, week.at(now), week.seed, len(run.times) + 1)
            outcome = take_in(DRIFT, MODEL, LIMITS, outcome.state, outcome.monitor, sweeps)
            run.times.append(now)
            run.sweeps.append(len(plan))
    run.decision_s = spent
    return run


def translations(*joints: int) -> Sweeps:
    """Translations of some joints over their range, the others at zero."""
    start = np.zeros((len(joints), 6))
    start[range(len(joints)), [j - 1 for j in joints]] = -150.0
    return Sweeps.make(start, -start, label=[f"q{j}" for j in joints])


def fixed(hours: float, plan: Sweeps) -> Rule:
    """The same sweeps at a fixed interval."""
    return lambda outcome, now, week: (hours, plan)


def never(outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Sweeps | None]:
    """No measurement after the calibration."""
    return HOURS * 2, None


def check_circle(hours: float, tolerance: float, plan: Sweeps) -> Rule:
    """Drive a circle at a fixed interval, and measure when it fails; the circle counts as no sweep."""

    def rule(outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Sweeps | None]:
        values = DRIFT.values(outcome.state.mean)
        task = task_path(CELL, MODEL.vector(values), "circle")
        ahead = min(now + hours, HOURS)
        error = float(peak_to_peak(task_errors(MODEL, week.at(ahead), values, task))[0])
        return hours, plan if error > tolerance else None

    return rule


def ours(goal: Goal, costs: Costs, fixed_hours: float | None = None) -> Rule:
    """The policy; with `fixed_hours` only its choice of sweeps, at a fixed interval."""
    policy = Policy.of(DRIFT, MODEL, goal, costs, PAPER)
    diagnosed = 0.0

    def rule(outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Sweeps | None]:
        nonlocal diagnosed
        if now == 0.0 or outcome.dof >= costs.diagnosis_sweeps:
            diagnosed = now
        forecast = Forecast.of(DRIFT, MODEL, goal, outcome.state.mean)
        state: State = forecast.ahead(outcome.state, now - outcome.state.time_h)
        if fixed_hours is not None:
            return fixed_hours, policy.choose(forecast, forecast.ahead(state, fixed_hours), costs.most_sweeps)
        due = "the robot moved" if outcome.verdict == "intrinsics-moved" else None
        # The session is planned for the last step that ends in tolerance.
        wait = STEP if due else max(STEP, forecast.hold_hours(state, costs.horizon_h))
        at_session = forecast.ahead(state, wait + 2.0 / 60.0)
        return wait, policy.decide(forecast, at_session, due, diagnosed).sweeps

    return rule


def rules(options: argparse.Namespace) -> dict[str, Rule]:
    """All policies by name."""
    tasks = tuple(options.tasks)
    two = translations(3, 1)
    found: dict[str, Rule] = {"never": never, "69 sweeps every 8 h": fixed(8.0, PAPER)}
    for hours in (0.5, 0.7, 1.0, 1.3, 2.0, 4.0):
        found[f"q3 and q1 every {hours:g} h"] = fixed(hours, two)
    found["q3 and q1 when a circle every 0.5 h fails"] = check_circle(0.5, options.tolerance * 1e-3, two)
    goal = Goal(options.tolerance * 1e-3, tasks)
    for count, intervals in ((1, (0.5, 0.7, 1.0, 1.3)), (2, (1.0, 1.3, 2.0, 4.0))):
        for hours in intervals:
            costs = Costs(most_sweeps=count)
            found[f"{count} chosen every {hours:g} h"] = ours(goal, costs, hours)
    for level in options.levels:
        found[f"ours, level {level:g}"] = ours(
            replace(goal, level=level), Costs(most_sweeps=options.most, diagnosis_h=options.diagnose)
        )
    return {name: rule for name, rule in found.items() if options.only in name}


def report(name: str, runs: list[Run], tolerance: float) -> str:
    """One line: sweeps, share in tolerance of the first task and of all, with standard errors over the weeks."""
    sweeps = np.array([sum(run.sweeps) for run in runs])
    first = np.array([(run.errors[0] <= tolerance).mean() for run in runs])
    worst = np.array([(run.errors.max(axis=0) <= tolerance).mean() for run in runs])
    error = 100.0 / np.sqrt(len(runs))
    sessions = np.mean([len(run.times) for run in runs])
    ms = 1e3 * sum(run.decision_s for run in runs) / max(1.0, sum(len(run.times) for run in runs))
    return (
        f"{name:44s} {sweeps.mean():7.1f} (most {sweeps.max():4d}) {sessions:6.1f} "
        f"{100 * first.mean():7.2f} ({first.std() * error:.2f}) {100 * worst.mean():7.2f} ({worst.std() * error:.2f}) "
        f"{ms:6.1f}"
    )


def parser() -> argparse.ArgumentParser:
    """The options of the study."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("--weeks", type=int, default=20)
    made.add_argument("--first", type=int, default=0, help="number of the first week")
    made.add_argument("--tolerance", type=float, default=50.0, help="peak to peak, in nm")
    made.add_argument("--tasks", nargs="+", default=["circle"])
    made.add_argument("--levels", type=float, nargs="+", default=[0.05, 0.1, 0.15, 0.2])
    made.add_argument("--most", type=int, default=2, help="sweeps of a session of ours, at most")
    made.add_argument("--diagnose", type=float, help="hours between looks at the robot itself (default: none)")
    made.add_argument("--harder", action="store_true", help="weeks that do not drift as modelled")
    made.add_argument("--only", default="", help="policies whose name holds this text")
    return made


def main() -> None:
    """Print the figures."""
    options = parser().parse_args()
    began = time.perf_counter()
    weeks = [simulate_week(seed, harder=options.harder) for seed in range(options.first, options.first + options.weeks)]
    print(f"{len(weeks)} weeks; tasks {', '.join(options.tasks)}; tolerance {options.tolerance:g} nm peak to peak")
    print(f"{'policy':44s}  sweeps             sessions  {options.tasks[0]} %   all tasks %   ms a decision")
    for name, rule in rules(options).items():
        runs = [follow(week, rule, tuple(options.tasks)) for week in weeks]
        print(report(name, runs, options.tolerance), flush=True)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
