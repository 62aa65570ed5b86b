"""The tasks a plan serves, over draws of the parameters: their derivatives and what is left out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.control.tasks import find_task
from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.task_error import task_jacobian
from fpcal_bayes.model.cavity import CavityModel

Floats = NDArray[np.float64]

#: Tasks that a plan serves unless others are named.
DEFAULT_TASKS = ("circle", "tilt-x", "tilt-z", "spin")
#: Points of a task's path at which plans are compared.
POINTS = 9


@dataclass(frozen=True)
class Goals:
    """Tasks at draws of the parameters.

    Attributes
    ----------
    values
        Free parameters of the draws at which every task can be driven to, shape (n_draws, n_free), in um and rad.
    jacobians
        Derivatives of each task's points by the free parameters, shape (n_draws, n_points, n_free).
    dropped
        Draws that were left out since a task has no point that can be driven to.
    """

    values: Floats
    jacobians: dict[str, Floats]
    dropped: int


def goals_of(
    model: CavityModel, values: Floats, tasks: Sequence[str], *, radius: float = 100.0, points: int = POINTS
) -> Goals:
    """The tasks at each draw, as a controller with these parameters would drive them.

    Points that cannot be driven to are replaced by the nearest on the path that can, so that every draw has as many.

    Parameters
    ----------
    values
        Draws of the free parameters, shape (n_draws, n_free), in um and rad.
    tasks
        Names or path files (see `find_task`).

    Raises
    ------
    InputError
        If a task is unknown, or there is no draw at which all of them can be driven to.
    """
    if not tasks:
        raise InputError("no task to plan for: expected one at least")
    kept: list[int] = []
    jacobians: dict[str, list[Floats]] = {task: [] for task in tasks}
    reason = ""
    for number, point in enumerate(values):
        try:
            found = {task: _at(model, point, task, radius, points) for task in tasks}
        except _UnreachableError as error:
            reason = str(error)
            continue
        kept.append(number)
        for task, jacobian in found.items():
            jacobians[task].append(jacobian)
    if not kept:
        raise InputError(f"{reason}: expected tasks that the cell can drive")
    stacked = {task: np.array(parts) for task, parts in jacobians.items()}
    return Goals(values[kept], stacked, len(values) - len(kept))


class _UnreachableError(Exception):
    """A task without a point that can be driven to."""


def _at(model: CavityModel, values: Floats, name: str, radius: float, points: int) -> Floats:
    try:
        task = find_task(model.cell, model.vector(values), name, radius=radius, n_points=points)
    except InputError as error:
        if "cannot be reached" in str(error):
            raise _UnreachableError(str(error)) from error
        raise
    if not task.ok.any() or not np.isfinite(task.start).all():
        raise _UnreachableError(f"task {task.name!r}: no point can be driven to; point 1: {task.status[0]}")
    good = np.flatnonzero(task.ok)
    jacobian = task_jacobian(model, values, task.take(task.ok))
    nearest = np.abs(np.arange(len(task))[:, None] - good).argmin(axis=1)
    result: Floats = jacobian[nearest]
    return result
