"""Simulated weeks of a cell that drifts and is measured again when a rule says so."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.simulator.sweeps import simulate
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import DriftModel, likely_terms
from fpcal_bayes.tracking.session import SessionOutcome, take_in
from fpcal_bayes.tracking.smoother import looked_at_again
from fpcal_bayes.tracking.start import with_hidden_noise
from fpcal_bayes.tracking.tracker import calibrate

#: Length of a simulated campaign, and the steps of the truth and of the looks at the error, in hours.
HOURS = 192.0
STEP = 0.1


@dataclass(frozen=True)
class Setting:
    """What all weeks of a study share.

    Attributes
    ----------
    cell
        With its drift sizes.
    sigma
        Standard deviation of each change of cavity length, in um.
    hours
        Length of a week.
    model, drift, paper, limits
        Made from the cell. The temperature is logged, so that the filter allows for its part (`likely_terms`).
    """

    cell: Cell
    sigma: float = 0.005
    hours: float = HOURS
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
        return simulate(self.cell, truth, timed, sigma=self.sigma, seed=number)


@dataclass(frozen=True)
class DriftingWeek:
    """Truth at every step, and the calibration at its beginning.

    Attributes
    ----------
    seed
        Numbers that the week's random numbers depend on.
    times
        In hours, shape (n_steps,).
    values
        Free parameters in um and rad, shape (n_steps, n_free).
    temperature_c
        Logged, shape (n_steps,).
    calibration
        What the first session gives.
    """

    seed: tuple[int, ...]
    times: Floats
    values: Floats
    temperature_c: Floats
    calibration: SessionOutcome

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
    """One policy through one week.

    Attributes
    ----------
    times, sweeps
        Of each session: when it began in hours, and how many sweeps it had.
    errors
        Peak to peak of each task's error in nm at every step, shape (n_tasks, n_steps).
    decision_s
        Time that the decisions took.
    """

    times: list[float]
    sweeps: list[int]
    errors: Floats
    decision_s: float = 0.0


#: What is measured next: after how many hours, and which sweeps (none: only look).
Rule = Callable[[SessionOutcome, float, DriftingWeek], tuple[float, Sweeps | None]]


def follow(setting: Setting, week: DriftingWeek, rule: Rule, tasks: Sequence[str]) -> Run:
    """Let a rule say when to measure, take in what it measures, and note the errors of the tasks."""
    outcome, now, spent = week.calibration, 0.0, 0.0
    outcomes, drift = [outcome], with_hidden_noise(setting.drift, setting.model, outcome.state)
    run = Run([], [], np.zeros((len(tasks), len(week.times))))
    while True:
        began = time.perf_counter()
        wait, plan = rule(outcome, now, week)
        spent += time.perf_counter() - began
        # Sessions begin on a step, and at most one on each.
        until = (np.floor(now / STEP + 1e-6) + max(1, np.floor(wait / STEP + 1e-6))) * STEP
        last = until > setting.hours - STEP / 2.0
        here = (week.times > now - STEP / 2) & (week.times < (setting.hours + 1 if last else until - STEP / 2))
        values = setting.drift.values(outcome.state.mean)
        for row, name in enumerate(tasks):
            task = task_path(setting.cell, setting.model.vector(values), name)
            run.errors[row, here] = 1e3 * peak_to_peak(task_errors(setting.model, week.values[here], values, task))
        if last:
            break
        now = until
        if plan is not None:
            sweeps = setting.measured(plan, now, week.at(now), week.temperature(now), *week.seed, len(run.times) + 1)
            outcomes.append(take_in(drift, setting.model, setting.limits, outcome.state, outcome.monitor, sweeps))
            outcome = outcomes[-1] = looked_at_again(drift, outcomes)
            run.times.append(now)
            run.sweeps.append(len(plan))
    run.decision_s = spent
    return run
