"""What an estimate leaves unknown of a task: nanometres of cavity length along its path.

The controller drives the joint path q of a task with an estimate. What it does not know is

    e(q) = [L(q; truth) - L(q0; truth)] - [L(q; estimate) - L(q0; estimate)],

L in the cell's own path model, q0 the joint vector of the aligned pose from which the task starts. To first order
e = J (truth - estimate), so that the covariance of an estimate gives the standard deviation of e, and draws of the
truth from a posterior give its distribution.
"""

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.motion.tasks import Task


def task_rows(model: CavityModel, task: Task) -> Rows:
    """The path of a task laid out for the kernels: each row is L(q) - L(q0)."""
    if not np.isfinite(task.start).all():
        raise InputError(f"task {task.name!r}: the aligned pose that it starts from is out of reach")
    if not task.finite.all():
        point = int(np.argmin(task.finite))
        raise InputError(f"task {task.name!r}: point {point + 1} of {len(task)}: {task.status[point]}")
    return model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)


def task_jacobian(model: CavityModel, values: Floats, task: Task) -> Floats:
    """Derivatives of L(q) - L(q0) along a task by the free parameters, at `values` (n_free,), (n_points, n_free)."""
    return model.predict_with_jacobian(values, task_rows(model, task))[1]


def linear_task_sd(jacobian: Floats, covariance: Floats) -> Floats:
    """First-order sd of the task error along the path, in um, (n_points,), by `task_jacobian` and a covariance."""
    variance = np.einsum("pi,ij,pj->p", jacobian, covariance, jacobian, optimize=True)
    # Rounding may leave a variance of zero slightly below it.
    return np.asarray(np.sqrt(np.clip(variance, 0.0, None)))


def task_errors(model: CavityModel, truth_values: Floats, estimate_values: Floats, task: Task) -> Floats:
    """Task error along the path for many truths (n_draws, n_free), in um and rad, shape (n_draws, n_points), in um.

    `estimate_values` (n_free,), or one set per truth, are those that the controller holds and found the path with.
    """
    rows = task_rows(model, task)
    return model.predict(np.atleast_2d(truth_values), rows) - model.predict(estimate_values, rows)


def peak_to_peak(errors: Floats) -> Floats:
    """Peak to peak of errors (..., n_points) along the path; shape (...), in the unit of the errors."""
    return np.ptp(errors, axis=-1)
