"""Simulated weeks of a cell that drifts and is measured again when a rule says so."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fpcal_bayes.decision import Sessions, run_rule, task_peaks
from fpcal_bayes.measure import Sweeps, Truth, paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.simulator import simulate_um
from fpcal_bayes.tracking import DriftModel, Limits, SessionOutcome, calibrate, followed_drift, likely_terms

Floats = np.ndarray

#: Length of a simulated campaign, and the steps of the truth and of the looks at the error, in hours.
HOURS = 192.0
STEP = 0.1


@dataclass(frozen=True)
class Setting:
    """What all weeks of a study share."""

    cell: Cell  # with its drift sizes
    sigma: float = 0.005  # standard deviation of each change of cavity length, in um
    hours: float = HOURS  # length of a week
    # model, drift, paper, limits: made from the cell. The temperature is logged, so that the filter allows for its part
    # (`likely_terms`).
    model: CavityModel = field(init=False)
    drift: DriftModel = field(init=False)
    paper: Sweeps = field(init=False)
    limits: Limits = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", CavityModel.of(self.cell))
        object.__setattr__(self, "drift", likely_terms(DriftModel.of(self.cell)))
        object.__setattr__(self, "paper", paper_protocol(self.cell))
        object.__setattr__(self, "limits", Limits())

    def measured(self, plan: Sweeps, time_h: float, values: Floats, temperature_c: float, *seed: int) -> Sweeps:
        """The sweeps of a plan, measured at a time; `values` are the truth then, shape (n_free,)."""
        number = int(np.random.default_rng([11, *seed]).integers(2**31))
        count = len(plan)
        timed = replace(
            plan,
            session=np.full(count, f"h{time_h:08.2f}"),
            time_h=np.full(count, time_h),
            temperature_c=np.full(count, temperature_c),
        )
        truth = Truth(self.cell.free, np.array([time_h]), values[None])
        return simulate_um(self.cell, truth, timed, sigma=self.sigma, seed=number)


@dataclass(frozen=True)
class DriftingWeek:
    """Truth at every step, and the calibration at its beginning."""

    seed: tuple[int, ...]  # numbers that the week's random numbers depend on
    times: Floats  # in hours, shape (n_steps,)
    values: Floats  # free parameters in um and rad, shape (n_steps, n_free)
    temperature_c: Floats  # logged, shape (n_steps,)
    calibration: SessionOutcome  # what the first session gives

    def at(self, time_h: float) -> Floats:
        """The truth at a time, shape (n_free,)."""
        here: Floats = self.values[self._step(time_h)]
        return here

    def temperature(self, time_h: float) -> float:
        """What is logged at a time."""
        return float(self.temperature_c[self._step(time_h)])

    def _step(self, time_h: float) -> int:
        return min(round(time_h / STEP), len(self.times) - 1)


def simulate_week(setting: Setting, *seed: int, harder: bool = False) -> DriftingWeek:
    """A week that drifts as modelled, or a harder one that the policies know nothing of.

    The harder week adds a day and night cycle of the mirror's and fibre's angles by 0.005 deg per kelvin, two knocks, a
    steady rate of one parameter, and one day on which nothing drifts.
    """
    cell, drift = setting.cell, setting.drift
    random = np.random.default_rng([7, *seed])
    times = STEP * np.arange(round(setting.hours / STEP) + 1, dtype=np.float64)
    steps = drift.walk * drift.scale * np.sqrt(STEP / 24.0) * random.standard_normal((len(times), len(cell.free)))
    steps[0] = 0.0
    temperature = np.full(len(times), 20.0)
    if harder:
        quiet = 24.0 * random.integers(1, 8)
        steps[(times > quiet) & (times <= quiet + 24.0)] = 0.0
        extrinsic_angle = drift.extrinsic & np.array([p.unit == "deg" for p in cell.free])
        for knock in random.uniform(min(12.0, setting.hours / 4.0), setting.hours - min(12.0, setting.hours / 4.0), 2):
            size = np.array([np.radians(0.1) if p.unit == "deg" else 20.0 for p in cell.free])
            steps[int(knock / STEP)] += np.where(drift.extrinsic, size * random.choice([-1.0, 1.0], len(size)), 0.0)
        steady = np.array([p.name == "theta_et" for p in cell.free])
        steps += np.where(steady, np.radians(0.03) * STEP / 24.0, 0.0)
        temperature = 20.0 + 2.0 * np.sin(2.0 * np.pi * times / 24.0)
        steps += np.diff(temperature, prepend=20.0)[:, None] * np.where(extrinsic_angle, np.radians(0.005), 0.0)
    values: Floats = paper_truth(cell).at(0.0) + np.cumsum(steps, axis=0)
    calibration, _, _ = calibrate(cell, drift, setting.measured(setting.paper, 0.0, values[0], 20.0, *seed, 0))
    return DriftingWeek(seed, times, values, temperature, calibration)


@dataclass
class Run:
    """One policy through one week."""

    # times, sweeps: of each session: when it began in hours, and how many sweeps it had
    times: list[float]
    sweeps: list[int]
    errors: Floats  # peak to peak of each task's error in nm at every step, shape (n_tasks, n_steps)
    decision_s: float = 0.0  # time that the decisions took


#: What is measured next: after how many hours, and which sweeps (none: only look).
Rule = Callable[[SessionOutcome, float, DriftingWeek], tuple[float, Sweeps | None]]


def follow(setting: Setting, week: DriftingWeek, rule: Rule, tasks: Sequence[str]) -> Run:
    """Let a rule say when to measure, take in what it measures, and note the errors of the tasks."""
    model, times, spent = setting.model, [0.0], 0.0

    def next_session(done: Sessions, now: float) -> tuple[float, Callable[[float], Sweeps | None]]:
        nonlocal spent
        began = time.perf_counter()
        wait, plan = rule(done.outcomes[-1], now, week)
        spent += time.perf_counter() - began
        return wait, lambda time_h: plan

    def measure(plan: Sweeps, time_h: float) -> Sweeps:
        seed = (*week.seed, len(times))
        times.append(time_h)
        return setting.measured(plan, time_h, week.at(time_h), week.temperature(time_h), *seed)

    drift = followed_drift(setting.drift, model, week.calibration)
    end_h = setting.hours - STEP / 2.0
    done = run_rule(next_session, drift, model, setting.limits, week.calibration, measure, end_h, step_h=STEP)
    truth = Truth(setting.cell.free, week.times, week.values)
    held = [(time_h, drift.values(outcome.state.mean)) for time_h, outcome in zip(times, done.outcomes, strict=True)]
    errors = 1e3 * task_peaks(model, truth, held, tasks, week.times, whole=True)
    return Run(times[1:], [len(sweeps) for sweeps in done.sweeps], errors, spent)
