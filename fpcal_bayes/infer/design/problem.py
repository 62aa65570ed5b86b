"""What a plan starts from: what is known of the cell, where that is linearised, and the tasks that count."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, UnreachableError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.information import Design
from fpcal_bayes.infer.design.rows import plan_rows, sweep_rows
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.infer.tasks.error import task_jacobian
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.margin import normal_draws
from fpcal_bayes.motion.tasks import find_task

#: Tasks that a plan serves unless others are named.
DEFAULT_TASKS = ("circle", "tilt-x", "tilt-z", "spin")
#: Points of a task's path at which plans are compared.
POINTS = 9


@dataclass(frozen=True)
class Goals:
    """Tasks at draws of the parameters."""

    # free parameters of the draws at which every task can be driven to, shape (n_draws, n_free), in um and rad
    values: Floats
    # derivatives of each task's points by the free parameters, shape (n_draws, n_points, n_free)
    jacobians: dict[str, Floats]
    dropped: int  # draws that were left out since a task has no point that can be driven to


def goals_of(
    model: CavityModel, values: Floats, tasks: Sequence[str], *, radius: float | None = None, points: int = POINTS
) -> Goals:
    """The tasks, names or path files, at each draw, as a controller with these parameters would drive them.

    `values` (n_draws, n_free) are in um and rad. Points that cannot be driven to are replaced by the nearest on the
    path that can, so that every draw has as many. `InputError` if a task is unknown, or there is no draw at which all
    of them can be driven to.
    """
    if not tasks:
        raise InputError("no task to plan for: expected one at least")
    kept: list[int] = []
    jacobians: dict[str, list[Floats]] = {task: [] for task in tasks}
    reason = ""
    for number, point in enumerate(values):
        try:
            found = {task: _at(model, point, task, radius, points) for task in tasks}
        except UnreachableError as error:
            reason = str(error)
            continue
        kept.append(number)
        for task, jacobian in found.items():
            jacobians[task].append(jacobian)
    if not kept:
        raise InputError(f"{reason}: expected tasks that the cell can drive")
    stacked = {task: np.array(parts) for task, parts in jacobians.items()}
    return Goals(values[kept], stacked, len(values) - len(kept))


def _at(model: CavityModel, values: Floats, name: str, radius: float | None, points: int) -> Floats:
    """Derivatives of a task's points by the free parameters, shape (points, n_free)."""
    task = find_task(model.cell, model.vector(values), name, radius=radius, n_points=points)
    if not task.ok.any() or not np.isfinite(task.start).all():
        raise UnreachableError(f"task {task.name!r}: no point can be driven to; point 1: {task.status[0]}")
    good = np.flatnonzero(task.ok)
    jacobian = task_jacobian(model, values, task.take(task.ok))
    nearest = np.abs(np.arange(len(task))[:, None] - good).argmin(axis=1)
    return jacobian[nearest]


@dataclass(frozen=True)
class Ground:
    """Knowledge before the planned sweeps."""

    model: CavityModel  # model of the parameters that are not known exactly
    centre: Floats  # where visibility and fringe rate are judged, shape (n_free,), in um and rad
    covariance: Floats  # of the free parameters, shape (n_free, n_free), in um and rad
    goals: Goals  # the tasks, at the draws over which the plan is averaged
    # whitened rows of what is measured in any case, shape (n_draws, n_rows, n_free), or None
    known: Floats | None = None

    @property
    def cell(self) -> Cell:
        """The cell that is planned for."""
        return self.model.cell

    @cached_property
    def draws(self) -> Floats:
        """Draws of what is known of the free parameters, shape (n_draws, n_free)."""
        return normal_draws(self.centre, self.covariance)

    def design(self, sweeps: Sweeps, *, readings: int, sigma: float) -> Design:
        """The sweeps as candidates (see `sweep_rows`)."""
        rows = sweep_rows(self.model, self.goals.values, sweeps, readings=readings, sigma=sigma)
        return Design.of(rows, self.goals.jacobians, self.covariance, self.known)

    def expected_sd(self, sweeps: Sweeps | None, *, readings: int = 2, sigma: float = 0.005) -> dict[str, float]:
        """Worst-point standard deviation of each task in um, the root of its mean variance over the draws.

        `sweeps` are a plan that is measured as a whole, or None for what is known without one.
        """
        each = self.sd_at_draws(sweeps, readings=readings, sigma=sigma)
        return {name: float(np.sqrt(np.mean(sd**2))) for name, sd in each.items()}

    def sd_at_draws(self, sweeps: Sweeps | None, *, readings: int = 2, sigma: float = 0.005) -> dict[str, Floats]:
        """Worst-point standard deviation of each task in um at each draw, shape (n_draws,) (see `expected_sd`)."""
        home = np.zeros((1, len(self.cell.joints)))
        design = self.design(Sweeps.of_um_rad(home, home) if sweeps is None else sweeps, readings=readings, sigma=sigma)
        variance = design.task_variance(() if sweeps is None else range(len(sweeps)))
        return {
            name: np.sqrt(variance[:, design.task_of_point == task].max(axis=1))
            for task, name in enumerate(design.names)
        }

    def at_draws(self, chosen: NDArray[np.int64]) -> "Ground":
        """The same averaged over some of the draws, by position."""
        jacobians = {name: jacobian[chosen] for name, jacobian in self.goals.jacobians.items()}
        goals = replace(self.goals, values=self.goals.values[chosen], jacobians=jacobians)
        return replace(self, goals=goals, known=None if self.known is None else self.known[chosen])

    def with_known(self, sweeps: Sweeps, sigma: float) -> "Ground":
        """The same with sweeps that are measured in any case; `sigma` in um where they say none."""
        used = replace(sweeps, sigma=np.where(np.isfinite(sweeps.sigma), sweeps.sigma, sigma))
        return replace(self, known=plan_rows(self.model, self.goals.values, used))


def prior_ground(
    cell: Cell,
    *,
    tasks: Sequence[str] = DEFAULT_TASKS,
    radius: float | None = None,
    draws: int = 64,
    points: int = POINTS,
    seed: int = 0,
) -> Ground:
    """A cell before its first calibration: its prior, averaged over `draws` draws of it."""
    model, free = CavityModel.of(cell), cell.free
    values = Prior.of(free).values(np.random.default_rng(seed).standard_normal((draws, len(free))))
    goals = goals_of(model, values, tasks, radius=radius, points=points)
    return Ground(model, free.nominal, np.diag(free.prior_sd**2), goals)


def estimate_ground(
    estimate: Estimate, *, tasks: Sequence[str] = DEFAULT_TASKS, radius: float | None = None, points: int = POINTS
) -> Ground:
    """A cell of which there is an estimate: its values and the covariance of all its parameters."""
    model = CavityModel.of(estimate.cell, estimate.parameters, estimate.vector())
    goals = goals_of(model, estimate.values[None], tasks, radius=radius, points=points)
    return Ground(model, estimate.values, estimate.covariance, goals)


def measured_estimate(cell: Cell, sweeps: Sweeps) -> Estimate:
    """What measured sweeps tell of a cell: the ground for the best next ones."""
    found = identify(cell, sweeps)
    if not found.converged:
        raise InputError(f"{sweeps.file}: the identification did not converge, expected sweeps that can be fitted")
    return found.estimate
