"""The direct geometric model (DGM) as 4x4 transforms, written to be read.

The compiled kernels in `fpcal_bayes.model.kernels` compute the same faster; tests hold them to this.
All functions also take complex model vectors, so that derivatives can be checked by complex steps.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS

Matrix = NDArray[Any]

_STRIDE = len(LINK_SLOTS)


def rot_x(angle: complex) -> Matrix:
    """Rotation about X as a 4x4 transform, paper equation (6)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def rot_y(angle: complex) -> Matrix:
    """Rotation about Y as a 4x4 transform, paper equation (5)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])


def rot_z(angle: complex) -> Matrix:
    """Rotation about Z as a 4x4 transform, paper equation (8)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def translation(x: complex, y: complex, z: complex) -> Matrix:
    """Translation as a 4x4 transform, paper equations (7) and (9)."""
    return np.array([[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def link_transform(link: Matrix, q: complex, prismatic: bool) -> Matrix:
    """Transform i-1Ti of a link, eight numbers in `LINK_SLOTS` order, at joint value `q`, paper equation (4)."""
    beta, alpha, d, theta, r, gain, runout_cos, runout_sin = link
    travel = q * (1 + gain)
    if prismatic:
        r = r + travel
    else:
        theta = theta + travel
        # A rotary axis with axial runout moves along itself once per turn.
        r = r + runout_cos * np.cos(travel) + runout_sin * np.sin(travel)
    return rot_y(beta) @ rot_x(alpha) @ translation(d, 0, 0) @ rot_z(theta) @ translation(0, 0, r)


def tool_pose(cell: Cell, vector: Matrix, q: Matrix) -> Matrix:
    """DGM: wTe (4, 4), the end-effector frame in the world, of model and joint vector; paper equation (12)."""
    pose = np.eye(4)
    for i, joint in enumerate(cell.joints):
        pose = pose @ link_transform(vector[_STRIDE * i : _STRIDE * (i + 1)], q[i], joint.kind == "prismatic")
    return pose


def mirror_in_tool(cell: Cell, vector: Matrix) -> Matrix:
    """eTt, the frame of the first beam's target in the end-effector frame: paper equation (14) for a mirror."""
    beta_et, theta_et, _, _, z_et, *_ = _extrinsics(vector)
    if cell.target == "corner-cube":
        return translation(beta_et, theta_et, z_et)
    return translation(0, 0, z_et) @ rot_x(beta_et) @ rot_y(theta_et)


def fibre_in_world(vector: Matrix) -> Matrix:
    """wTf, the fibre frame in the world frame, paper equation (13)."""
    _, _, beta_wf, theta_wf, _, x_wf, y_wf, z_wf = _extrinsics(vector)
    return translation(x_wf, y_wf, z_wf) @ rot_x(beta_wf) @ rot_z(theta_wf)


def mirror_pose(cell: Cell, vector: Matrix, q: Matrix) -> Matrix:
    """wTt, the mirror frame in the world frame, paper equation (19); shape (4, 4)."""
    return tool_pose(cell, vector, q) @ mirror_in_tool(cell, vector)


def optical_axis(cell: Cell, vector: Matrix) -> Matrix:
    """Unit vector (3,) of the light in the world, or of vectors (n, size), (n, 3): minus the second column of (13)."""
    beta, theta = vector[..., -6], vector[..., -5]
    if cell.optical_axis == "z":
        return np.stack([0.0 * beta, -np.sin(beta), np.cos(beta)], axis=-1)
    return np.stack([np.sin(theta), -np.cos(beta) * np.cos(theta), -np.sin(beta) * np.cos(theta)], axis=-1)


def reflection_point(cell: Cell, vector: Matrix, q: Matrix) -> tuple[Matrix, Matrix]:
    """Reflection points wPr, tPr (3,) in um, paper (28), (29); foot of the fibre end on the perpendicular path."""
    mirror, fibre = mirror_pose(cell, vector, q), fibre_in_world(vector)
    if cell.target == "corner-cube":
        return mirror[:3, 3], np.zeros(3)
    normal, origin = mirror[:3, 2], fibre[:3, 3]
    along = optical_axis(cell, vector) if cell.opd == "axis" else normal
    point = origin + along * (normal @ (mirror[:3, 3] - origin) / (normal @ along))
    return point, mirror[:3, :3].T @ (point - mirror[:3, 3])


def _extrinsics(vector: Matrix) -> Matrix:
    return vector[-len(EXTRINSICS) :]
