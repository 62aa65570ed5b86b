"""What an estimate leaves unknown of a task: nanometres of cavity length and degrees along its path.

The controller drives the joint path q of a task with an estimate. What it does not know is

    e(q) = [L(q; truth) - L(q0; truth)] - [L(q; estimate) - L(q0; estimate)],

L in the cell's own path model, q0 the joint vector of the aligned pose from which the task starts. To first order
e = J (truth - estimate), so that the covariance of an estimate gives the standard deviation of e, and draws of the
truth from a posterior give its distribution.
"""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.model.inverse import InverseModel
from fpcal_bayes.motion.placement import turns
from fpcal_bayes.motion.tasks import Task


@dataclass(frozen=True)
class AngularErrors:
    """Errors of the mirror's direction along a path, in rad."""

    # angle between the true mirror normal and the one the estimate expects, each seen from its own fibre frame, shape
    # (n_draws, n_points)
    normal: Floats
    # angle of the rotation by which the true turn since the aligned pose differs from the one the estimate expects,
    # shape (n_draws, n_points)
    turn: Floats
    # that rotation about Xf, Yf, Zf, shape (n_draws, n_points, 3)
    about: Floats


def task_rows(model: CavityModel, task: Task) -> Rows:
    """The path of a task laid out for the kernels: each row is L(q) - L(q0)."""
    if not np.isfinite(task.start).all():
        raise InputError(f"task {task.name!r}: the aligned pose that it starts from is out of reach")
    if not task.finite.all():
        point = int(np.argmin(task.finite))
        raise InputError(f"task {task.name!r}: point {point + 1} of {len(task)}: {task.status[point]}")
    return model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)


def task_jacobian(model: CavityModel, values: Floats, task: Task) -> Floats:
    """Derivatives of L(q) - L(q0) along a task by the model's free parameters, shape (n_points, n_free).

    They are taken at `values` (n_free,), in um and rad.
    """
    _, jacobian = model.predict_with_jacobian(values, task_rows(model, task))
    return jacobian


def linear_task_sd(jacobian: Floats, covariance: Floats) -> Floats:
    """Standard deviation of the task error along the path, to first order, in um, shape (n_points,).

    `jacobian` (n_points, n_free) is from `task_jacobian`, `covariance` that of the free parameters in um and rad.
    """
    variance = np.einsum("pi,ij,pj->p", jacobian, covariance, jacobian, optimize=True)
    # Rounding may leave a variance of zero slightly below it.
    sd: Floats = np.sqrt(np.clip(variance, 0.0, None))
    return sd


def task_errors(model: CavityModel, truth_values: Floats, estimate_values: Floats, task: Task) -> Floats:
    """Task error along the path for many truths, in um, shape (n_draws, n_points), in the model's path model.

    `truth_values` (n_draws, n_free) are in um and rad; `estimate_values` (n_free,) those that the controller holds, or
    one set a truth (n_draws, n_free); `task` is the joint path that was found with the estimate.
    """
    rows = task_rows(model, task)
    truths = np.atleast_2d(truth_values)
    return model.predict(truths, rows) - model.predict(estimate_values, rows)


def turn_errors(model: CavityModel, truth_values: Floats, estimate_values: Floats, task: Task) -> tuple[Floats, Floats]:
    """Rotations between the mirror as it stands and as the estimate expects it, for many truths; as in `task_errors`.

    Tilts of the mirror normal, each seen from its own fibre frame, along the expected mirror's X and Y, shape (n_draws,
    n_points, 2), and rotation vectors of the turn since the aligned pose, shape (n_draws, n_points, 3); in rad.
    """
    task_rows(model, task)
    true = _mirrors(model, np.atleast_2d(truth_values), task)
    expected = _mirrors(model, np.atleast_2d(estimate_values), task)
    normal = (np.swapaxes(expected, -1, -2) @ true[..., 2:])[..., 0]
    across = np.hypot(normal[..., 0], normal[..., 1])
    tilt = normal[..., :2] * (np.arctan2(across, normal[..., 2]) / np.where(across > 0, across, 1.0))[..., None]
    true_turn, expected_turn = (frames @ np.swapaxes(frames[:, :1], -1, -2) for frames in (true, expected))
    since = _rotation_vectors(true_turn @ np.swapaxes(expected_turn, -1, -2))
    return tilt[:, 1:], since[:, 1:]


def angular_errors(
    model: CavityModel, truth_values: Floats, estimate_values: Floats, task: Task, *, linear: bool = False
) -> AngularErrors:
    """Angular errors along the path for many truths, as in `task_errors`; `linear`: to first order."""
    if not linear:
        tilt, since = turn_errors(model, truth_values, estimate_values, task)
    else:
        # Central differences: the rotations are smooth, and half a step changes the angles by parts in 1e8.
        steps = np.diag(1e-3 * model.free.prior_sd)
        width = 2e-3 * model.free.prior_sd
        ahead = turn_errors(model, estimate_values + steps, estimate_values, task)
        behind = turn_errors(model, estimate_values - steps, estimate_values, task)
        slopes = [(a - b) / width[:, None, None] for a, b in zip(ahead, behind, strict=True)]
        change = np.atleast_2d(truth_values) - estimate_values
        tilt, since = (np.tensordot(change, slope, axes=1) for slope in slopes)
    return AngularErrors(np.linalg.norm(tilt, axis=-1), np.linalg.norm(since, axis=-1), since)


def peak_to_peak(errors: Floats) -> Floats:
    """Peak to peak of errors (..., n_points) along the path; shape (...), in the unit of the errors."""
    return np.ptp(errors, axis=-1)


def _mirrors(model: CavityModel, values: Floats, task: Task) -> Floats:
    """Mirror orientations in the fibre frame at the start and along the path, shape (n_draws, 1 + n_points, 3, 3)."""
    vectors = np.array([model.vector(v) for v in values])
    tools = InverseModel(model.cell).tool_poses(vectors, np.vstack([task.start, task.q]))[..., :3, :3]
    extrinsics = vectors[:, -8:]
    zero = np.zeros(len(vectors))
    # eTt turns about X then the new Y, wTf about X then the new Z.
    about_x = turns(np.column_stack([extrinsics[:, 0], zero, zero]))
    mirror = about_x @ turns(np.column_stack([zero, extrinsics[:, 1], zero]))
    fibre = turns(np.column_stack([extrinsics[:, 2], zero, zero])) @ turns(
        np.column_stack([zero, zero, extrinsics[:, 3]])
    )
    return fibre.transpose(0, 2, 1)[:, None] @ tools @ mirror[:, None]


def _rotation_vectors(rotations: Floats) -> Floats:
    """Rotation vector of each rotation (..., 3, 3), in rad, shape (..., 3); exact near zero."""
    skew = np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(skew, axis=-1) / 2.0
    angle = np.arctan2(sine, (np.trace(rotations, axis1=-2, axis2=-1) - 1.0) / 2.0)
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 1.0)
    return skew / 2.0 * factor[..., None]
