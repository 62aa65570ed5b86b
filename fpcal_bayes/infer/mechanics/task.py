"""The error of a task on a machine: what geometry, error motions and return leave unknown along its path."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_jacobian
from fpcal_bayes.model.mechanics import path_design
from fpcal_bayes.model.mechanics.design import drift_sd
from fpcal_bayes.model.mechanics.terms import DRIFT_ORDER
from fpcal_bayes.motion.tasks import Task

#: Points of a path: return errors make a peak to peak grow with their number, so it is fixed and stated.
PATH_POINTS = 31


@dataclass(frozen=True)
class MechanicsTaskErrors:
    """Draws of a task's error along its path, in um.

    Attributes
    ----------
    repeatable
        By geometry, error motions, reversal and encoders: the same each time, shape (n_draws, n_points).
    returned
        By return errors: another one each time, same shape.
    """

    repeatable: Floats
    returned: Floats

    @property
    def total(self) -> Floats:
        """Both, shape (n_draws, n_points)."""
        return self.repeatable + self.returned

    def peak_to_peak_band(self, share: float = 0.95) -> Floats:
        """Lower and upper edge of the peak to peak of the total, shape (2,)."""
        return np.quantile(peak_to_peak(self.total), [(1 - share) / 2, (1 + share) / 2])

    def band(self, share: float = 0.95) -> Floats:
        """Lower and upper edge at each point, shape (2, n_points)."""
        return np.quantile(self.total, [(1 - share) / 2, (1 + share) / 2], axis=0)


def mechanics_task_errors(fit: MechanicsFit, task: Task, *, seed: int = 0) -> MechanicsTaskErrors:
    """Draw the error of a task that was found with the fit's own geometry.

    The errors are of first order in what is unknown. The task is driven point by point from its aligned pose, which was
    reached from an unknown side, at some time of the session.
    """
    rng = np.random.default_rng([seed, 2])
    draws, model = fit.draws, fit.problem.model
    at = fit.solution.unknowns[: fit.problem.n_free]
    jacobian = fit.problem.prior.by_scores(task_jacobian(model, fit.values, task), at)
    path = path_design(fit.terms, model.vector(fit.values), task.start, task.q)
    n_draws, n_points = len(draws.scores), len(task)
    change = draws.scores[:, : fit.problem.n_free] - at
    repeatable = change @ jacobian.T + draws.weights[:, : fit.design.motion_count] @ path.motions.T
    index = {name: i for i, name in enumerate(fit.terms.scales)}

    if path.unknown_side.any():
        approach = np.exp(draws.log_scales[:, index["approach"]])
        signs = rng.choice([-1.0, 1.0], (n_draws, path.unknown_side.shape[1]))
        repeatable += (approach[:, None] * signs) @ path.unknown_side.T

    drifting = [i for i, name in enumerate(fit.design.names) if name.startswith("drift along")]
    if drifting:
        sd = drift_sd(fit.terms, float(fit.drive.end_min.max()))
        when = rng.uniform(-1.0, 1.0, n_draws)
        values = np.column_stack([when, 1.5 * when**2 - 0.5])[:, :DRIFT_ORDER]
        by_order = draws.weights[:, drifting].reshape(n_draws, DRIFT_ORDER, 3)
        moved = (by_order * (values * sd)[:, :, None]).sum(axis=1)
        repeatable += moved @ path.drift.T

    factor = np.exp(draws.log_scales[:, index["return"]])[:, None]
    returned = np.zeros((n_draws, n_points))
    for joint in np.flatnonzero(path.returned_point.any(axis=0)):
        reached = rng.standard_normal((n_draws, int(path.steps[:, joint].max(initial=0)) + 1))
        returned += factor * (reached[:, path.steps[:, joint]] * path.returned_point[:, joint])
        returned -= factor * reached[:, :1] * path.returned_start[:, joint]
    return MechanicsTaskErrors(repeatable, returned)
