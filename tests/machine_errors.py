"""The error of a task on a machine, straight from a fit: what an estimate hands on must say the same."""

import numpy as np

from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.tasks.error import task_jacobian
from fpcal_bayes.model.mechanics.design import path_design
from fpcal_bayes.model.mechanics.errors import MechanicsTaskErrors, approached, drifted, encoder_errors, returned_errors
from fpcal_bayes.motion.tasks import Task


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
    change = draws.scores[:, : fit.problem.n_free] - at
    repeatable = change @ jacobian.T + draws.weights[:, : fit.design.motion_count] @ path.motions.T
    drifting = [i for i, name in enumerate(fit.design.names) if name.startswith("drift along")]
    session_min = fit.drive.session_min
    repeatable += sum(approached(fit.terms, path, draws.log_scales, rng).values())
    repeatable += sum(encoder_errors(fit.terms, path, draws.log_scales, rng).values())
    repeatable += drifted(fit.terms, path, draws.weights[:, drifting], session_min, rng)
    returned = np.sum(
        [np.zeros_like(repeatable), *returned_errors(fit.terms, path, draws.log_scales, rng).values()], axis=0
    )
    return MechanicsTaskErrors(repeatable, returned)
