"""Simulated weeks: is the filter honest about its errors, and does it notice what was not modelled?

Each week drifts as the cell's sizes say, from the paper's first identification or from a draw of the prior. A full
calibration comes first, then sessions of few sweeps. `--change` adds a step of beta_4 or a knock of mirror and fibre.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy import stats

from fpcal_bayes.decision import Costs, Forecaster, Goal, Policy
from fpcal_bayes.infer import task_rows
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import PROTOCOLS, Sweeps, Truth, join, paper_truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import task_path
from fpcal_bayes.simulator import simulate_um
from fpcal_bayes.tracking import DriftModel, State, Track, calibrate, predict, smooth, track, with_learnt_pace

HOURS = 192.0
#: What a reference that judges all tasks together may err by, in um.
REFERENCE = 0.001
#: Points of each task whose errors are compared with their covariance.
POINTS = {"circle": (1, 2), "tilt-x": (0, 4), "tilt-z": (0, 4), "spin": (0, 4)}


@cache
def protocol(name: str) -> Sweeps:
    """A protocol of the built-in cell, as a plan."""
    return PROTOCOLS[name](load_cell(mechanics="none"))


def session_times(hours: float, random: np.random.Generator, *, regular: bool) -> np.ndarray:
    """Times of the sessions after the calibration: at random over the week, or nearly regular."""
    count = round(HOURS / hours)
    if regular:
        return np.arange(1, count + 1) * hours - random.uniform(0.0, hours / 4.0, count)
    return np.sort(random.uniform(0.0, HOURS, count))


def session_plan(count: int, kind: str, random: np.random.Generator) -> Sweeps:
    """Sweeps of one session.

    ``varied``: the joints in turn, each over its range, at random poses. ``mixed``: at times rows of the paper's
    protocol, at times one random joint from and to random values.
    """
    high = np.array([150.0, 150.0, 150.0, *np.radians([3.0, 3.0, 90.0])])
    if kind == "mixed" and random.random() < 0.5:
        return protocol("paper").take(random.choice(69, count, replace=False))
    start = random.uniform(-high, high, (count, 6))
    joint = np.arange(count) % 6 if kind == "varied" else random.integers(0, 6, count)
    rows, end = np.arange(count), start.copy()
    if kind == "varied":
        start[rows, joint], end[rows, joint] = -high[joint], high[joint]
    else:
        end[rows, joint] = random.uniform(-high[joint], high[joint])
    return Sweeps.of_um_rad(start, end, label=[f"q{j + 1}" for j in joint])


def diagnosis_plan(cell: Cell, values: np.ndarray, count: int, hours: float, seed: int) -> Sweeps:
    """The sweeps by which the policy would look at the robot some hours after a calibration at `values` (n,)."""
    drift, model, plan, goal = DriftModel.of(cell), CavityModel.of(cell), protocol("paper"), Goal(50.0)
    measured = simulate_um(cell, Truth(cell.free, np.zeros(1), values[None]), plan, sigma=0.005, seed=seed)
    known = calibrate(cell, drift, measured)[0].state
    policy = Policy.of(drift, model, goal, Costs(diagnosis_sweeps=count), plan)
    return policy.choose_diagnosis(Forecaster.of(drift, model, goal, known.mean), predict(drift, known, hours))


def change_of(cell: Cell, kind: str, random: np.random.Generator) -> np.ndarray:
    """What is added to the truth from the change on, in um and rad, shape (n,)."""
    sign = random.choice([-1.0, 1.0], len(cell.free))
    if kind == "beta_4":
        return np.where([p.name == "beta_4" for p in cell.free], np.radians(0.1) * sign, 0.0)
    size = np.array([np.radians(0.1) if p.unit == "deg" else 20.0 for p in cell.free])
    return np.where([p.kind == "extrinsic" for p in cell.free], size * sign, 0.0)


@dataclass(frozen=True)
class SimulatedWeek:
    """Truth, sweeps, and the number of the first session after the change."""

    truth: Truth
    sweeps: Sweeps
    changed: int | None


def simulate_week(cell: Cell, options: argparse.Namespace, seed: int) -> SimulatedWeek:
    """One week that drifts as the cell's sizes say."""
    random = np.random.default_rng([options.seed, seed])
    drift = DriftModel.of(cell)
    start = paper_truth(cell).at(0.0)
    if options.start == "prior":
        start = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
    regular = options.change != "none" or options.regular
    times = np.concatenate([[0.0], session_times(options.hours, random, regular=regular)])
    steps = np.sqrt(np.diff(times, prepend=0.0) / 24.0)[:, None] * drift.walk * drift.scale
    values = start + np.cumsum(steps * random.standard_normal(steps.shape), axis=0)
    changed = None
    if options.change != "none":
        changed = int(random.integers(3, len(times) - 4))
        values[changed:] += change_of(cell, options.change, random)
    calibration = protocol(options.protocol)
    parts = [replace(calibration, session=np.full(len(calibration), "0000"))]
    look = None
    if options.sweeps == "diagnosis":
        look = diagnosis_plan(cell, start, options.most, options.hours, int(random.integers(2**31)))
    for number, hour in enumerate(times[1:], 1):
        count = int(random.integers(options.fewest, options.most + 1))
        plan = session_plan(count, options.sweeps, random) if look is None else look.take(np.arange(count))
        parts.append(replace(plan, session=np.full(count, f"{number:04d}"), time_h=np.full(count, hour)))
    truth = Truth(cell.free, times, values)
    sweeps = simulate_um(cell, truth, join(parts), sigma=0.005, seed=int(random.integers(2**31)))
    return SimulatedWeek(truth, sweeps, changed)


def taken_in(cell: Cell, sweeps: Sweeps) -> Iterator[Track]:
    """The track after each session but the first, with the pace that its sessions support, as `fpcal track` has it."""
    parts = [sweeps.of_session(name) for name in sweeps.sessions]
    drift, found = DriftModel.of(cell), track(cell, parts[0])
    for k in range(2, len(parts) + 1):
        known = join(parts[:k])

        def taken(before: Track, known: Sweeps = known) -> Track:
            return track(cell, known, drift=replace(drift, pace=before.drift.pace), known=before)

        found = with_learnt_pace(taken(found), parts[:k], taken)
        yield found


def told_in_time(cell: Cell, sweeps: Sweeps) -> Track:
    """The whole track, each session as it was told when it was the last."""
    tracks = list(taken_in(cell, sweeps))
    return replace(tracks[-1], outcomes=(tracks[-1].outcomes[0], *(found.last for found in tracks)))


class TaskSpace:
    """Errors of a state along tasks, in units of their own covariance."""

    def __init__(self, cell: Cell) -> None:
        self.model = CavityModel.of(cell)
        self.drift = DriftModel.of(cell)
        vector = self.model.vector(paper_truth(cell).at(0.0))
        self.tasks = {}
        for name, points in POINTS.items():
            task = task_path(cell, vector, name, n_points=5)
            self.tasks[name] = task.take(np.isin(np.arange(5), points))
        self.rows = {name: task_rows(self.model, task) for name, task in self.tasks.items()}

    def squared(self, state: State, truth: np.ndarray) -> list[float]:
        """Normalised error squared over degrees of freedom: a task each, all tasks, all as seen by a reference.

        All tasks together have directions that are known to half a nanometre, where curvature is all that is left.
        The last figure asks what matters to a user: it compares with a reference that itself errs by `REFERENCE` at
        each point, and is the mean over that error. It is one too if all is as it should be.
        """
        n, values = self.drift.n_parameters, self.drift.values(state.mean)
        errors, jacobians = [], []
        for rows in self.rows.values():
            predicted, jacobian = self.model.predict_with_jacobian(values, rows)
            errors.append(predicted - self.model.predict(truth, rows))
            jacobians.append(jacobian * self.drift.scale)
        pairs = [*zip(errors, jacobians, strict=True), (np.concatenate(errors), np.vstack(jacobians))]
        found = []
        for error, jacobian in pairs:
            covariance = jacobian @ state.covariance[:n, :n] @ jacobian.T
            found.append(float(error @ np.linalg.solve(covariance, error)) / len(error))
        inverse = np.linalg.inv(covariance + REFERENCE**2 * np.eye(len(error)))
        return [*found, float(error @ inverse @ error + REFERENCE**2 * np.trace(inverse)) / len(error)]


@dataclass
class Tally:
    """Figures of all weeks."""

    nis: list[np.ndarray] = field(default_factory=list)
    errors: dict[str, list[np.ndarray]] = field(default_factory=lambda: {"before": [], "after": [], "smoothed": []})
    hours: list[np.ndarray] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    sessions: int = 0

    def add(self, week: SimulatedWeek, found: Track, space: TaskSpace) -> None:
        """Take in one week."""
        after = found.outcomes[1:]
        self.nis.append(np.array([(o.nis, o.dof) for o in after]))
        self.hours.append(np.array([o.time_h for o in after]))
        truth = week.truth.values[1:]
        smoothed = smooth(found.drift, found.outcomes).states[1:]
        for name, states in (
            ("before", [o.predicted for o in after]),
            ("after", [o.state for o in after]),
            ("smoothed", smoothed),
        ):
            squared = [space.squared(state, values) for state, values in zip(states, truth, strict=True)]
            self.errors[name].append(np.array(squared))
        verdicts = [o.verdict for o in found.outcomes]
        if week.changed is None:
            self.counts["weeks with a false full calibration"] += "intrinsics-moved" in verdicts
            self.counts["false full calibrations"] += verdicts.count("intrinsics-moved")
            self.counts["false extrinsic alarms"] += verdicts.count("extrinsics-moved")
            return
        k = week.changed
        self.counts["intrinsics-moved within 3 sessions"] += "intrinsics-moved" in verdicts[k : k + 3]
        self.counts["extrinsics-moved at the next session"] += verdicts[k] == "extrinsics-moved"
        self.counts["any alarm at the next session"] += verdicts[k] != "as-modelled"
        self.counts["false full calibrations"] += verdicts[:k].count("intrinsics-moved")
        self.counts["full calibrations later"] += verdicts[k + 3 :].count("intrinsics-moved")

    def report(self) -> list[str]:
        """Lines for people."""
        nis = np.concatenate(self.nis)
        share = nis[:, 0].sum() / nis[:, 1].sum()
        lines = [
            f"NIS / dof {share:.4f}, standard error {_clustered([w[:, 0].sum() / w[:, 1].sum() for w in self.nis])}"
        ]
        p = stats.chi2.cdf(nis[:, 0], nis[:, 1])
        lines.append(
            f"within the 95 % bounds: {100 * ((p > 0.025) & (p < 0.975)).mean():.2f} % of {len(p)} sessions "
            f"(standard error {100 * np.sqrt(0.0475 / len(p)):.2f} %)"
        )
        names = [*POINTS, "all tasks", "all tasks to a nanometre"]
        for when, weeks in self.errors.items():
            means = np.array([week.mean(axis=0) for week in weeks])
            figures = ", ".join(
                f"{name} {mean:.3f} ({se:.3f})"
                for name, mean, se in zip(
                    names, means.mean(axis=0), means.std(axis=0) / np.sqrt(len(means)), strict=True
                )
            )
            lines.append(f"task error squared / dof, {when}: {figures}")
        lines.append(f"circle and all tasks (to a nanometre) before updates, by two days: {self._by_time()}")
        lines.append(f"{1e3 * self.seconds / self.sessions:.2f} ms a session")
        return lines + [f"{name}: {count} of {len(self.nis)} weeks" for name, count in self.counts.items()]

    def _by_time(self) -> str:
        parts = []
        for low in np.arange(0.0, HOURS, 48.0):
            weeks = [
                week[(hours >= low) & (hours < low + 48.0)]
                for week, hours in zip(self.errors["before"], self.hours, strict=True)
            ]
            means = np.array([week.mean(axis=0) for week in weeks if len(week)])[:, [0, -1]]
            error = means.std(axis=0) / np.sqrt(len(means))
            parts.append(" / ".join(f"{m:.3f} ({e:.3f})" for m, e in zip(means.mean(axis=0), error, strict=True)))
        return "; ".join(parts)


def _clustered(weeks: list[float]) -> str:
    """Standard error of a mean over weeks, which are independent."""
    return f"{np.std(weeks) / np.sqrt(len(weeks)):.4f}"


def run(options: argparse.Namespace) -> Tally:
    """Simulate and follow the weeks."""
    cell = load_cell(mechanics="none")
    space, tally = TaskSpace(cell), Tally()
    for seed in range(options.weeks):
        week = simulate_week(cell, options, seed)
        began = time.perf_counter()
        found = (told_in_time if options.pace else track)(cell, week.sweeps)
        tally.seconds += time.perf_counter() - began
        tally.sessions += len(found.outcomes)
        tally.add(week, found, space)
    return tally


def parser() -> argparse.ArgumentParser:
    """The options of the study."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("--weeks", type=int, default=20)
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--hours", type=float, default=8.0, help="between sessions, on average")
    made.add_argument("--regular", action="store_true", help="sessions nearly regular, not at random times")
    made.add_argument("--fewest", type=int, default=1, help="sweeps of a session, at least")
    made.add_argument("--most", type=int, default=12, help="and at most")
    made.add_argument("--sweeps", choices=("mixed", "varied", "diagnosis"), default="mixed")
    made.add_argument("--start", choices=("paper", "prior"), default="paper", help="truth at the calibration")
    made.add_argument("--protocol", choices=tuple(PROTOCOLS), default="paper", help="of the calibration")
    made.add_argument("--change", choices=("none", "beta_4", "knock"), default="none")
    made.add_argument("--pace", action="store_true", help="session by session, the pace of drift learnt")
    return made


def main() -> None:
    """Print the figures."""
    began = time.perf_counter()
    for line in run(parser().parse_args()).report():
        print(line)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
