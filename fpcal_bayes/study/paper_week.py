"""The paper's week on the simulated cell: sweeps on days 0, 1, 2, 7 and 8, each identified as the paper did.

Between the tables of the paper the truth either moves steadily, or walks at random with the drift sizes of the cell.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.tasks.error import task_errors, task_rows
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.traces import PathTrace
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.tasks import Task, task_path
from fpcal_bayes.simulator.recorder import record_path
from fpcal_bayes.simulator.sweeps import machine_of, simulate_um, vector_at

#: The paper's Fig 13: every 2 h for 14 h.
CHECK_HOURS = tuple(2.0 * number for number in range(8))
RADIUS = 100.0
_POINTS = 181


@dataclass(frozen=True)
class Circle:
    """A circle in the mirror plane, driven once with an estimate."""

    name: str
    time_h: float  # when it was driven
    estimate: str  # name of the session that the estimate is of
    phase: Floats  # of its points in deg, shape (n,)
    change: Floats  # true change of cavity length beyond what the estimate expects, shape (n,), in um
    trace: PathTrace  # irradiance along the circle, with its reference scans, as the rig records it

    @property
    def peak_to_peak(self) -> float:
        """Peak to peak of the change, in um."""
        return float(np.ptp(self.change))


def check_circles(cell: Cell, truth: Truth, name: str, estimate: Estimate, seed: int) -> list[Circle]:
    """The circle of the estimate of session `name`, driven at `CHECK_HOURS` after it; `seed` is that of the noise."""
    task = _circle(estimate)
    times = [estimate.time_h + hours for hours in CHECK_HOURS]
    return [
        _driven(cell, truth, task, estimate, f"check-{hours:02.0f}h", time_h, name, seed + number, seed)
        for number, (hours, time_h) in enumerate(zip(CHECK_HOURS, times, strict=True))
    ]


def renewed_circles(
    cell: Cell, truth: Truth, estimates: dict[str, Estimate], seed: int, machine_seed: int
) -> list[Circle]:
    """The circle of each identification at its own time, and before it with that of the identification before.

    The estimates are by session, in order of time; `seed` is of the recordings' noise, `machine_seed` of the
    machine.
    """
    circles: list[Circle] = []
    before = ""
    for name, estimate in estimates.items():
        used = [(before, "before")] if before else []
        for held, when in [*used, (name, "after")]:
            task = _circle(estimates[held])
            number = seed + len(circles)
            label = f"{when}-{name}"
            circles.append(
                _driven(cell, truth, task, estimates[held], label, estimate.time_h, held, number, machine_seed)
            )
        before = name
    return circles


def _circle(estimate: Estimate) -> Task:
    return task_path(estimate.cell, estimate.vector(), "circle", radius=RADIUS, n_points=_POINTS).driven()


def driven_error(cell: Cell, truth: Truth, task: Task, estimate: Estimate, time_h: float, seed: int) -> Floats:
    """True change of cavity length along a task beyond what is wanted, shape (n,), in um; `seed` is the machine's."""
    model = CavityModel.of(cell, truth.parameters)
    expected = estimate.vector()[truth.parameters.slots]
    if cell.mechanics is None:
        driven: Floats = task_errors(model, truth.at(time_h), expected, task)[0]
        return driven
    machine = replace(machine_of(cell, truth, seed), vector=vector_at(cell, truth, time_h))
    true = machine.path(task.start, task.q, 0.0)
    missed: Floats = true - model.predict(expected, task_rows(model, task))
    return missed if task.added is None else missed + task.added


def _driven(
    cell: Cell,
    truth: Truth,
    task: Task,
    estimate: Estimate,
    name: str,
    time_h: float,
    held: str,
    seed: int,
    machine_seed: int,
) -> Circle:
    change = driven_error(cell, truth, task, estimate, time_h, machine_seed)
    trace = record_path(cell, truth, task.q, time_h, seed=seed, machine_seed=machine_seed)
    return Circle(name, time_h, held, task.along, change - change[0], trace)


_STEP_H = 0.5

Free = Literal["all", "extrinsic"]


@dataclass(frozen=True)
class PaperSession:
    """One session of the week."""

    # name, day: as in the campaign
    name: str
    day: float
    free: Free  # what is identified; the rest is held at the last full identification
    tables: str  # the tables of the paper that it makes anew


SESSIONS = (
    PaperSession("full-T0", 0.0, "all", "Tables II and III"),
    PaperSession("full-day1", 1.0, "all", "Tables V and IV"),
    PaperSession("full-day2", 2.0, "all", "Tables VI and IV"),
    PaperSession("extrinsic-day7", 7.0, "extrinsic", "Table IV"),
    PaperSession("full-day8", 8.0, "all", "Tables VII and IV"),
)


@dataclass(frozen=True)
class Week:
    """What the week gave: the truth, the sweeps of all sessions, and an identification of each."""

    cell: Cell
    truth: Truth
    sweeps: Sweeps
    identifications: dict[str, Identification]


def week_truth(cell: Cell, between: str, seed: int) -> Truth:
    """The truth through the week: the paper's tables on days 0, 1, 2 and 8, and what lies between them.

    `between` is ``steady``, or ``walk`` for a random walk, by `seed`, with the cell's drift sizes, given the tables.
    """
    tables = paper_truth(cell)
    if between == "steady":
        return tables
    sizes = {size.name: size.walk for size in cell.drift}
    walk = np.array([sizes.get(name, 0.0) for name in tables.parameters.names]) * np.sqrt(_STEP_H / 24.0)
    times = np.arange(0.0, tables.times_h[-1] + _STEP_H / 2.0, _STEP_H)
    random = np.random.default_rng([seed, 2])
    path = np.cumsum(np.vstack([0.0 * walk, walk * random.standard_normal((len(times) - 1, len(walk)))]), axis=0)
    # A walk less its own line between the days of the tables is a Brownian bridge.
    at_tables = Truth(tables.parameters, tables.times_h, path[np.searchsorted(times, tables.times_h - 1e-9)])
    return Truth(tables.parameters, times, tables.at(times) + path - at_tables.at(times))


def measure_week(cell: Cell, *, sigma: float, seed: int, between: str = "steady") -> tuple[Truth, Sweeps]:
    """The truth through the week (see `week_truth`), and simulated sweeps of all sessions in order of time.

    `sigma` is the standard deviation of each change of cavity length in um, `seed` that of the noise.
    """
    truth = week_truth(cell, between, seed)
    plan = join([paper_protocol(cell, session=s.name, time_h=24.0 * s.day) for s in SESSIONS], file="week")
    return truth, simulate_um(cell, truth, plan, sigma=sigma, seed=seed)


def identify_session(
    cell: Cell, sweeps: Sweeps, session: PaperSession, full: Identification | None, data: dict[str, str]
) -> Identification:
    """Identify one session; `full` is the last full identification, at which an extrinsic one holds the rest."""
    start = None if session.free == "all" or full is None else full.estimate
    result = identify(cell, sweeps.of_session(session.name), free=session.free, start=start)
    return replace(result, estimate=replace(result.estimate, data={**data, "session": session.name}))
