"""What an estimate leaves unknown of where the mirror stands along a task, by degree of freedom.

Pose fX is that of the mirror frame at the mirror's point that reflects at joint zero, in the fibre frame; truth
and estimate have their own. What counts is how it changes since the aligned pose q0 from which a task starts: absolute
place across and along the beam, and absolute spin, are not evaluated, since no change of length tells them.
Lengths do not tell a common turn of all moves about the beam either: it is taken out of the moves of each path, so that
their lengths and the angles between them remain. Along the beam the change of cavity length stands for the place.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.error import task_rows
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.inverse import InverseModel
from fpcal_bayes.motion.placement import turns
from fpcal_bayes.motion.tasks import Task

#: Degrees of freedom beside the one along the beam: moves across it in um, then turns about Xf, Yf (spin), Zf in rad.
FREEDOMS = ("x", "z", "rx", "ry", "rz")
#: No pose of a path that moves less than this, in um, across the beam tells a common turn.
_LEAST_MOVE = 1.0


@dataclass(frozen=True, repr=False)
class PoseErrors(Brief):
    """Errors of the mirror's place and direction along a path."""

    normal: Floats  # angle between true and expected normal, each from its fibre frame, rad, (n_draws, n_points)
    # by which the true change of pose since the start differs from the one the estimate expects, in the order of
    # `FREEDOMS`, in um and rad, shape (n_draws, n_points, 5)
    changes: Floats

    @property
    def turn(self) -> Floats:
        """Angle of the rotation by which the turns since the start differ, in rad, shape (n_draws, n_points)."""
        return np.asarray(np.linalg.norm(self.changes[..., 2:], axis=-1))

    def of(self, freedom: str) -> Floats:
        """One of `FREEDOMS`, in um or rad, shape (n_draws, n_points)."""
        return self.changes[..., FREEDOMS.index(freedom)]


def pose_changes(
    model: CavityModel, truth_values: Floats, estimate_values: Floats, task: Task
) -> tuple[Floats, Floats]:
    """Tilts of the normal along the expected mirror's X, Y in rad, (n_draws, n_points, 2), and `PoseErrors.changes`."""
    task_rows(model, task)
    true, place = _mirrors(model, np.atleast_2d(truth_values), task)
    expected, wanted = _mirrors(model, np.atleast_2d(estimate_values), task)
    normal = (np.swapaxes(expected, -1, -2) @ true[..., 2:])[..., 0]
    across = np.hypot(normal[..., 0], normal[..., 1])
    tilt = normal[..., :2] * (np.arctan2(across, normal[..., 2]) / np.where(across > 0, across, 1.0))[..., None]
    true_turn, expected_turn = (frames @ np.swapaxes(frames[:, :1], -1, -2) for frames in (true, expected))
    turned_on = true_turn @ np.swapaxes(expected_turn, -1, -2)
    since = Rotation.from_matrix(turned_on.reshape(-1, 3, 3)).as_rotvec().reshape(turned_on.shape[:-1])
    moved, asked = ((points[:, 1:] - points[:, :1])[..., [0, 2]] for points in (place, wanted))
    # As complex numbers a common turn is a factor of modulus one.
    moved, asked = moved @ [1.0, 1.0j], asked @ [1.0, 1.0j]
    turned = np.where(np.abs(asked).max() > _LEAST_MOVE, (moved.conj() * asked).sum(axis=1, keepdims=True), 1.0)
    off = moved * turned / np.abs(turned) - asked
    return tilt[:, 1:], np.concatenate([np.stack([off.real, off.imag], axis=-1), since[:, 1:]], axis=-1)


def without_common_turn(model: CavityModel, values: Floats, task: Task, changes: Floats) -> Floats:
    """Small changes of pose (..., n_points, 5) with the common turn of their moves taken out, to first order."""
    _, wanted = _mirrors(model, np.atleast_2d(values), task)
    across = (wanted[0, 1:] - wanted[0, :1])[:, [2, 0]] * [1.0, -1.0]
    if np.abs(across).max() <= _LEAST_MOVE:
        return changes
    result = changes.copy()
    turn = np.einsum("...pk,pk->...", changes[..., :2], across) / (across**2).sum()
    result[..., :2] -= turn[..., None, None] * across
    return result


def pose_jacobian(model: CavityModel, values: Floats, task: Task) -> tuple[Floats, Floats]:
    """Derivatives of both results of `pose_changes` by the free parameters, shape (n_free, n_points, 2) and (.., 5)."""
    # Central differences: poses are smooth, and half a step changes them by parts in 1e8.
    steps, width = np.diag(1e-3 * model.free.prior_sd), 2e-3 * model.free.prior_sd[:, None, None]
    ahead, behind = (pose_changes(model, values + side * steps, values, task) for side in (1.0, -1.0))
    return (ahead[0] - behind[0]) / width, (ahead[1] - behind[1]) / width


def pose_errors(
    model: CavityModel, truth_values: Floats, estimate_values: Floats, task: Task, *, linear: bool = False
) -> PoseErrors:
    """Errors along the path for many truths, as in `task_errors`; `linear`: to first order."""
    if not linear:
        tilt, changes = pose_changes(model, truth_values, estimate_values, task)
    else:
        away = np.atleast_2d(truth_values) - estimate_values
        tilt, changes = (np.tensordot(away, slope, axes=1) for slope in pose_jacobian(model, estimate_values, task))
    return PoseErrors(np.linalg.norm(tilt, axis=-1), changes)


def _mirrors(model: CavityModel, values: Floats, task: Task) -> tuple[Floats, Floats]:
    """Mirror orientations (n_draws, 1 + n_points, 3, 3) and places of its point, in the fibre frame, start first."""
    vectors, cell = np.array([model.vector(v) for v in values]), model.cell
    tools = InverseModel(cell).tool_poses(vectors, np.vstack([np.zeros_like(task.start), task.start, task.q]))
    beta_et, theta_et, beta_wf, theta_wf, z_et = vectors[:, -8:-3].T
    zero = np.zeros(len(vectors))
    # eTt turns about X then the new Y, wTf about X then the new Z.
    in_tool = turns(np.column_stack([beta_et, zero, zero])) @ turns(np.column_stack([zero, theta_et, zero]))
    fibre = turns(np.column_stack([beta_wf, zero, zero])) @ turns(np.column_stack([zero, zero, theta_wf]))
    mirror = tools[..., :3, :3] @ in_tool[:, None]
    origin = tools[..., :3, 3] + z_et[:, None, None] * tools[..., :3, 2] - vectors[:, None, -3:]
    # The point that reflects at joint zero, seen from the mirror's origin.
    normal, beam = mirror[:, 0, :, 2], fibre[..., 2] if cell.optical_axis == "z" else -fibre[..., 1]
    along = beam if cell.opd == "axis" else normal
    length = (origin[:, 0] * normal).sum(axis=-1) / (along * normal).sum(axis=-1)
    point = (np.swapaxes(mirror[:, 0], -1, -2) @ (along * length[:, None] - origin[:, 0])[..., None])[:, None]
    back = np.swapaxes(fibre, -1, -2)[:, None]
    return (back @ mirror)[:, 1:], (back @ (origin[..., None] + mirror @ point))[:, 1:, :, 0]
