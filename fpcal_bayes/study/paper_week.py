"""The paper's week on the simulated cell: sweeps on days 0, 1, 2, 7 and 8, each identified as the paper did.

Between the tables of the paper the truth moves steadily.
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
    drives = [(f"check-{hours:02.0f}h", estimate.time_h + hours, name, estimate) for hours in CHECK_HOURS]
    return _driven(cell, truth, drives, seed, seed)


def renewed_circles(
    cell: Cell, truth: Truth, estimates: dict[str, Estimate], seed: int, machine_seed: int
) -> list[Circle]:
    """The circle of each identification, by session, at its own time; before it, that of the one before."""
    drives, before = [], ""
    for name, estimate in estimates.items():
        for held, when in ((before, "before"), (name, "after")):
            if held:
                drives.append((f"{when}-{name}", estimate.time_h, held, estimates[held]))
        before = name
    return _driven(cell, truth, drives, seed, machine_seed)


def _driven(
    cell: Cell, truth: Truth, drives: list[tuple[str, float, str, Estimate]], seed: int, machine_seed: int
) -> list[Circle]:
    """Circles by name, time, and the session with its estimate that each is driven with."""
    circles = []
    for number, (name, time_h, session, estimate) in enumerate(drives, start=seed):
        task = task_path(estimate.cell, estimate.vector(), "circle", radius=RADIUS, n_points=_POINTS).driven()
        change = driven_error(cell, truth, task, estimate, time_h, machine_seed)
        trace = record_path(cell, truth, task.q, time_h, seed=number, machine_seed=machine_seed)
        circles.append(Circle(name, time_h, session, task.along, change - change[0], trace))
    return circles


def driven_error(cell: Cell, truth: Truth, task: Task, estimate: Estimate, time_h: float, seed: int) -> Floats:
    """True change of cavity length along a task beyond what is wanted, shape (n,), in um; `seed` is the machine's."""
    model = CavityModel.of(cell, truth.parameters)
    expected = estimate.vector()[truth.parameters.slots]
    if cell.mechanics is None:
        return np.asarray(task_errors(model, truth.at(time_h), expected, task)[0])
    machine = replace(machine_of(cell, truth, seed), vector=vector_at(cell, truth, time_h))
    missed: Floats = machine.path(task.start, task.q, 0.0) - model.predict(expected, task_rows(model, task))
    return missed if task.added is None else missed + task.added


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


def measure_week(cell: Cell, *, sigma: float, seed: int) -> tuple[Truth, Sweeps]:
    """The truth through the week, and simulated sweeps of all sessions in order of time; `sigma` in um."""
    truth = paper_truth(cell)
    plan = join([paper_protocol(cell, session=s.name, time_h=24.0 * s.day) for s in SESSIONS], file="week")
    return truth, simulate_um(cell, truth, plan, sigma=sigma, seed=seed)


def identify_session(
    cell: Cell, sweeps: Sweeps, session: PaperSession, full: Identification | None, data: dict[str, str]
) -> Identification:
    """Identify one session; `full` is the last full identification, at which an extrinsic one holds the rest."""
    start = None if session.free == "all" or full is None else full.estimate
    result = identify(cell, sweeps.of_session(session.name), free=session.free, start=start)
    return replace(result, estimate=replace(result.estimate, data={**data, "session": session.name}))
