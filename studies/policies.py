"""When to measure again: simulated weeks under several policies, share of time in tolerance against sweeps spent.

Each week starts with a full calibration. It drifts as the cell's sizes say, or is harder (`--harder`): a day and night
cycle of temperature that moves mirror and fibre, two knocks, a steady rate of one parameter, and one quiet day.
The temperature is logged, so that the filter allows for its part and for steady rates, whose sizes it does not know
(`likely_terms`); `--stated` leaves them out. The controller drives each task with the latest estimate; the error is
looked at every six minutes. All policies see the same weeks and the same filter.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fpcal_bayes.core.files import write_json
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.diagnosis import is_diagnosis
from fpcal_bayes.decision.forecast import Forecast, Goal
from fpcal_bayes.decision.policy import Policy
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.simulator.sweeps import simulate
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import DriftModel, likely_terms
from fpcal_bayes.tracking.session import SessionOutcome, take_in
from fpcal_bayes.tracking.smoother import looked_at_again
from fpcal_bayes.tracking.start import with_hidden_noise
from fpcal_bayes.tracking.tracker import calibrate

HOURS = 192.0
#: Steps of the truth and of the looks at the error, in hours.
STEP = 0.1
SIGMA = 0.005

CELL = load_cell()
MODEL = CavityModel.of(CELL)
STATED = DriftModel.of(CELL)
ANGLES = STATED.extrinsic & np.array([p.unit == "deg" for p in CELL.free])
PAPER = paper_protocol(CELL)
LIMITS = Limits()


@dataclass(frozen=True)
class Week:
    """Truth and temperature at every step, and the calibration at its beginning."""

    seed: int
    drift: DriftModel
    times: np.ndarray
    values: np.ndarray
    temperature: np.ndarray
    calibration: SessionOutcome = field(init=False)

    def __post_init__(self) -> None:
        sweeps = self.measured(PAPER, 0.0, 0)
        object.__setattr__(self, "calibration", calibrate(CELL, self.drift, sweeps)[0])

    def measured(self, plan: Sweeps, time_h: float, number: int) -> Sweeps:
        """The sweeps of a plan, measured at a time."""
        at, count = min(round(time_h / STEP), len(self.times) - 1), len(plan)
        seed = int(np.random.default_rng([11, self.seed, number]).integers(2**31))
        timed = replace(
            plan,
            session=np.full(count, f"h{time_h:08.2f}"),
            time_h=np.full(count, time_h),
            temperature_c=np.full(count, self.temperature[at]),
        )
        truth = Truth(CELL.free, np.array([time_h]), self.values[at][None])
        return simulate(CELL, truth, timed, sigma=SIGMA, seed=seed)

    def peaks(self, state: np.ndarray, task_name: str, here: np.ndarray | int) -> np.ndarray:
        """Peak to peak of the error of a task in nm while the controller holds a state, at steps `here`."""
        values = STATED.values(state)
        task = task_path(CELL, MODEL.vector(values), task_name)
        found: np.ndarray = 1e3 * peak_to_peak(task_errors(MODEL, self.values[here], values, task))
        return found


def simulate_week(seed: int, *, harder: bool = False, stated: bool = False) -> Week:
    """A week that drifts as modelled, or a harder one."""
    random = np.random.default_rng([7, seed])
    times = np.arange(round(HOURS / STEP) + 1) * STEP
    steps = STATED.walk * STATED.scale * np.sqrt(STEP / 24.0) * random.standard_normal((len(times), len(CELL.free)))
    steps[0] = 0.0
    temperature = np.full(len(times), 20.0)
    if harder:
        quiet = 24.0 * random.integers(1, 8)
        steps[(times > quiet) & (times <= quiet + 24.0)] = 0.0
        for knock in random.uniform(12.0, HOURS - 12.0, 2):
            size = np.array([np.radians(0.1) if p.unit == "deg" else 20.0 for p in CELL.free])
            steps[int(knock / STEP)] += np.where(STATED.extrinsic, size * random.choice([-1.0, 1.0], len(size)), 0.0)
        steady = np.array([p.name == "theta_et" for p in CELL.free])
        steps += np.where(steady, np.radians(0.03) * STEP / 24.0, 0.0)
        temperature = 20.0 + 2.0 * np.sin(2.0 * np.pi * times / 24.0)
        steps += np.diff(temperature, prepend=20.0)[:, None] * np.where(ANGLES, np.radians(0.005), 0.0)
    values = paper_truth(CELL).at(0.0) + np.cumsum(steps, axis=0)
    return Week(seed, STATED if stated else likely_terms(STATED), times, values, temperature)


@dataclass
class Run:
    """One policy through one week: when it measured, how much, and the error in nm at every step, a row a task."""

    times: list[float]
    sweeps: list[int]
    errors: np.ndarray
    decision_s: float = 0.0


#: Which sweeps are measured at a time (none: only look).
Chosen = Callable[[float], Sweeps | None]
#: What comes next: after how many hours something is measured, and what then.
Rule = Callable[[SessionOutcome, float, Week], tuple[float, Chosen]]
#: Told of each session that was measured.
Told = Callable[[SessionOutcome, SessionOutcome, Sweeps], None]


def follow(week: Week, rule: Rule, tasks: tuple[str, ...]) -> Run:
    """Let a rule say when to measure, take in what it measures, and note the errors of the tasks."""
    outcome, now, told = week.calibration, 0.0, getattr(rule, "told", None)
    outcomes, drift = [outcome], with_hidden_noise(week.drift, MODEL, outcome.state)
    run = Run([], [], np.zeros((len(tasks), len(week.times))))
    while True:
        began = time.process_time()
        wait, chosen = rule(outcome, now, week)
        run.decision_s += time.process_time() - began
        # Sessions begin on a step, and at most one on each.
        until = (np.floor(now / STEP + 1e-6) + max(1, np.floor(wait / STEP + 1e-6))) * STEP
        last = until > HOURS - STEP / 2.0
        here = (week.times > now - STEP / 2) & (week.times < (HOURS + 1 if last else until - STEP / 2))
        for row, name in enumerate(tasks):
            run.errors[row, here] = week.peaks(outcome.state.mean, name, here)
        if last:
            return run
        now = until
        began = time.process_time()
        plan = chosen(now)
        run.decision_s += time.process_time() - began
        if plan is not None:
            sweeps = week.measured(plan, now, len(run.times) + 1)
            before = outcome
            outcomes.append(take_in(drift, MODEL, LIMITS, before.state, before.monitor, sweeps))
            outcome = outcomes[-1] = looked_at_again(drift, outcomes)
            if told is not None:
                told(before, outcome, sweeps)
            run.times.append(now)
            run.sweeps.append(len(plan))


def translations(*joints: int, at: np.ndarray | None = None) -> Sweeps:
    """Translations of some joints over their range, the others at zero or at a joint vector `at`."""
    start = np.zeros((len(joints), 6)) if at is None else np.tile(at, (len(joints), 1))
    end, rows, moved = start.copy(), range(len(joints)), [j - 1 for j in joints]
    start[rows, moved], end[rows, moved] = -150.0, 150.0
    return Sweeps.make(start, end, label=[f"q{j}" for j in joints])


def fixed(hours: float, plan: Sweeps) -> Rule:
    """The same sweeps at a fixed interval."""
    return lambda outcome, now, week: (hours, lambda at: plan)


def fixed_at_task(hours: float) -> Rule:
    """Both translations at a fixed interval, made at the aligned pose of the estimate."""

    def rule(outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Chosen]:
        vector = MODEL.vector(STATED.values(outcome.state.mean))
        pose = task_path(CELL, vector, "circle", n_points=5).start
        return hours, lambda at: translations(3, 1, at=pose)

    return rule


def never(outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Chosen]:
    """No measurement after the calibration."""
    return HOURS * 2, lambda at: None


def check_circle(hours: float, tolerance: float, plan: Sweeps) -> Rule:
    """Drive a circle at a fixed interval, and measure when it fails; the circle counts as no sweep."""

    def rule(outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Chosen]:
        def chosen(at: float) -> Sweeps | None:
            error = week.peaks(outcome.state.mean, "circle", [min(round(at / STEP), len(week.times) - 1)])[0]
            return plan if error > tolerance else None

        return hours, chosen

    return rule


class Ours:
    """The policy; with `fixed_hours` only its choice of sweeps, at a fixed interval."""

    def __init__(self, drift: DriftModel, goal: Goal, costs: Costs, fixed_hours: float | None = None) -> None:
        self.policy = Policy.of(drift, MODEL, goal, costs, PAPER)
        self.fixed_hours = fixed_hours
        self.diagnosed = 0.0

    def told(self, before: SessionOutcome, outcome: SessionOutcome, sweeps: Sweeps) -> None:
        """Note when the robot itself was last looked at."""
        policy = self.policy
        if policy.costs.diagnosis_h and is_diagnosis(policy.drift, MODEL, before, outcome, sweeps, policy.limits):
            self.diagnosed = outcome.time_h

    def __call__(self, outcome: SessionOutcome, now: float, week: Week) -> tuple[float, Chosen]:
        policy = self.policy
        if now == 0.0:
            self.diagnosed = 0.0
        forecast = Forecast.of(policy.drift, MODEL, policy.goal, outcome.state.mean)
        due = "the robot moved" if outcome.verdict == "intrinsics-moved" else None

        def chosen(at: float) -> Sweeps | None:
            state = forecast.ahead(outcome.state, at - outcome.time_h)
            if self.fixed_hours is not None:
                return policy.choose(forecast, state, policy.costs.most_sweeps)
            return policy.measure_now(forecast, state, due, self.diagnosed).sweeps

        if self.fixed_hours is not None:
            return self.fixed_hours, chosen
        return 0.0 if due else policy.hold_hours(forecast, outcome.state, self.diagnosed), chosen


def rules(options: argparse.Namespace) -> dict[str, Rule]:
    """All policies by name."""
    tasks, drift = tuple(options.tasks), STATED if options.stated else likely_terms(STATED)
    two = translations(3, 1)
    found: dict[str, Rule] = {"never": never, "69 sweeps every 8 h": fixed(8.0, PAPER)}
    for hours in (0.7, 1.0, 1.5, 2.0, 4.0):
        found[f"q3 and q1 at joint zero every {hours:g} h"] = fixed(hours, two)
    for hours in (0.7, 1.0, 1.3, 1.6, 2.0, 4.0):
        found[f"q3 and q1 at the task every {hours:g} h"] = fixed_at_task(hours)
    found["q3 and q1 when a circle every 0.5 h fails"] = check_circle(0.5, options.tolerance, two)
    goal = Goal(options.tolerance * 1e-3, tasks)
    for hours in options.chosen:
        found[f"{options.most} chosen every {hours:g} h"] = Ours(drift, goal, Costs(most_sweeps=options.most), hours)
    costs = Costs(least_sweeps=options.least, most_sweeps=options.most, diagnosis_h=options.diagnose)
    for level in options.levels:
        found[f"ours, level {level:g}"] = Ours(drift, replace(goal, level=level), costs)
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
    weeks = [simulate_week(seed, harder=options.harder, stated=options.stated) for seed in numbers]
    print(f"{len(weeks)} weeks; tasks {', '.join(options.tasks)}; tolerance {options.tolerance:g} nm peak to peak")
    tasks = tuple(options.tasks)
    print(
        f"{'policy':44s}  sweeps             sessions  {' %, '.join((*tasks, 'all'))} % (standard error)  ms a session"
    )
    results = {}
    for name, rule in rules(options).items():
        results[name] = figures([follow(week, rule, tasks) for week in weeks], tasks, options.tolerance)
        print(report(name, results[name], tasks), flush=True)
        if options.json is not None:
            about = {"tasks": tasks, "tolerance_nm": options.tolerance, "harder": options.harder}
            write_json(options.json, about | {"policies": results})
    print(f"{time.perf_counter() - began:.0f} s, {time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
