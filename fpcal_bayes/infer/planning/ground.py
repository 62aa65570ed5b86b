"""What a plan starts from: what is known of the cell, where that is linearised, and the tasks that count."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.identify import identify
from fpcal_bayes.infer.planning.design import Design
from fpcal_bayes.infer.planning.goals import DEFAULT_TASKS, POINTS, Goals, goals_of
from fpcal_bayes.infer.planning.rows import plan_rows, sweep_rows
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.estimate import Estimate

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Ground:
    """Knowledge before the planned sweeps.

    Attributes
    ----------
    model
        Cavity model of the parameters that are not known exactly.
    centre
        Where visibility and fringe rate are judged, shape (n_free,), in um and rad.
    covariance
        Of the free parameters, shape (n_free, n_free), in um and rad.
    goals
        The tasks, at the draws over which the plan is averaged.
    known
        Whitened rows of what is measured in any case, shape (n_draws, n_rows, n_free), or None.
    """

    model: CavityModel
    centre: Floats
    covariance: Floats
    goals: Goals
    known: Floats | None = None

    @property
    def cell(self) -> Cell:
        """The cell that is planned for."""
        return self.model.cell

    def design(self, sweeps: Sweeps, *, readings: int, sigma: float) -> Design:
        """The sweeps as candidates (see `sweep_rows`)."""
        rows = sweep_rows(self.model, self.goals.values, sweeps, readings=readings, sigma=sigma)
        return Design.of(rows, self.goals.jacobians, self.covariance, self.known)

    def expected_sd(self, sweeps: Sweeps | None, *, readings: int = 2, sigma: float = 0.005) -> dict[str, float]:
        """Worst-point standard deviation of each task in um, the root of its mean variance over the draws.

        Parameters
        ----------
        sweeps
            A plan that is measured as a whole, or None for what is known without one.
        """
        each = self.sd_at_draws(sweeps, readings=readings, sigma=sigma)
        return {name: float(np.sqrt(np.mean(sd**2))) for name, sd in each.items()}

    def sd_at_draws(self, sweeps: Sweeps | None, *, readings: int = 2, sigma: float = 0.005) -> dict[str, Floats]:
        """Worst-point standard deviation of each task in um at each draw, shape (n_draws,) (see `expected_sd`)."""
        home = np.zeros((1, len(self.cell.joints)))
        design = self.design(Sweeps.make(home, home) if sweeps is None else sweeps, readings=readings, sigma=sigma)
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
    radius: float = 100.0,
    draws: int = 64,
    points: int = POINTS,
    seed: int = 0,
) -> Ground:
    """A cell before its first calibration: its prior, averaged over `draws` draws of it.

    Raises
    ------
    InputError
        If a task is unknown, or cannot be driven to at any draw.
    """
    model, free = CavityModel.of(cell), cell.free
    values = free.nominal + free.prior_sd * np.random.default_rng(seed).standard_normal((draws, len(free)))
    goals = goals_of(model, values, tasks, radius=radius, points=points)
    return Ground(model, free.nominal, np.diag(free.prior_sd**2), goals)


def estimate_ground(
    estimate: Estimate, *, tasks: Sequence[str] = DEFAULT_TASKS, radius: float = 100.0, points: int = POINTS
) -> Ground:
    """A cell of which there is an estimate: its values and the covariance of all its parameters.

    Raises
    ------
    InputError
        If a task is unknown or cannot be driven to.
    """
    model = CavityModel.of(estimate.cell, estimate.parameters, estimate.vector())
    goals = goals_of(model, estimate.values[None], tasks, radius=radius, points=points)
    return Ground(model, estimate.values, estimate.covariance, goals)


def measured_estimate(cell: Cell, sweeps: Sweeps) -> Estimate:
    """What measured sweeps tell of a cell: the ground for the best next ones.

    Raises
    ------
    InputError
        If the identification does not converge.
    """
    found = identify(cell, sweeps)
    if not found.converged:
        raise InputError(f"{sweeps.file}: the identification did not converge, expected sweeps that can be fitted")
    return found.estimate
