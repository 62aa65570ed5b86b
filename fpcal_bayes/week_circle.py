"""The circles of the simulated week: the paper's checks every two hours, and after each identification."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.control.tasks import Task, task_path
from fpcal_bayes.infer.task_error import task_errors
from fpcal_bayes.measure.path_trace import PathTrace
from fpcal_bayes.measure.recorder import record_path
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.estimate import Estimate

Floats = NDArray[np.float64]

#: The paper's Fig 13: every 2 h for 14 h.
CHECK_HOURS = tuple(2.0 * number for number in range(8))
RADIUS = 100.0
_POINTS = 181


@dataclass(frozen=True)
class Circle:
    """A circle in the mirror plane, driven once with an estimate.

    Attributes
    ----------
    name
        Of the recording.
    time_h
        When it was driven.
    estimate
        Name of the session that the estimate is of.
    phase
        Of its points in deg, shape (n,).
    change
        True change of cavity length beyond what the estimate expects, shape (n,), in um.
    trace
        Irradiance along the circle, with its reference scans, as the rig records it.
    """

    name: str
    time_h: float
    estimate: str
    phase: Floats
    change: Floats
    trace: PathTrace

    @property
    def peak_to_peak(self) -> float:
        """Of the change, in um."""
        return float(np.ptp(self.change))


def check_circles(cell: Cell, truth: Truth, name: str, estimate: Estimate, seed: int) -> list[Circle]:
    """The circle of one estimate, driven at `CHECK_HOURS` after it.

    Parameters
    ----------
    name
        Of the session that the estimate is of.
    seed
        Of the recordings' noise.

    Raises
    ------
    InputError
        If the circle cannot be driven.
    """
    task = _circle(estimate)
    times = [estimate.time_h + hours for hours in CHECK_HOURS]
    return [
        _driven(cell, truth, task, estimate, f"check-{hours:02.0f}h", time_h, name, seed + number)
        for number, (hours, time_h) in enumerate(zip(CHECK_HOURS, times, strict=True))
    ]


def renewed_circles(cell: Cell, truth: Truth, estimates: dict[str, Estimate], seed: int) -> list[Circle]:
    """The circle of each identification at its own time, and before it with that of the identification before.

    Parameters
    ----------
    estimates
        By session, in order of time.
    seed
        Of the recordings' noise.

    Raises
    ------
    InputError
        If a circle cannot be driven.
    """
    circles: list[Circle] = []
    before = ""
    for name, estimate in estimates.items():
        used = [(before, "before")] if before else []
        for held, when in [*used, (name, "after")]:
            task = _circle(estimates[held])
            number = seed + len(circles)
            circles.append(_driven(cell, truth, task, estimates[held], f"{when}-{name}", estimate.time_h, held, number))
        before = name
    return circles


def _circle(estimate: Estimate) -> Task:
    return task_path(estimate.cell, estimate.vector(), "circle", radius=RADIUS, n_points=_POINTS).driven()


def _driven(
    cell: Cell, truth: Truth, task: Task, estimate: Estimate, name: str, time_h: float, held: str, seed: int
) -> Circle:
    model = CavityModel.of(cell, truth.parameters)
    expected = estimate.vector()[truth.parameters.slots]
    change = task_errors(model, truth.at(time_h), expected, task)[0]
    trace = record_path(cell, truth, task.q, time_h, seed=seed)
    return Circle(name, time_h, held, task.along, change - change[0], trace)
