"""What a small motion of the chain at one joint does to the cavity length, exact to first order.

Joint j stands in a base frame: that of its link behind beta, alpha and d, before it moves. An error motion moves
all that the joint carries by a displacement and a tilt, whose directions are fixed in the base frame. With normal n,
fibre end f, optical axis a, N = n.(o - f) and D = n.a, a displacement changes N by n.delta, a tilt w about a point c
changes n by w x n and N by (w x n).(c - f), and

    dL = (dN - L dD) / D    (axis),        dL = sign(N) dN    (perpendicular).

A target that is a point p moves by delta + w x (p - c), of which its length sees the part along the light.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS

#: Directions of an error motion: displacements, then tilts; own axis, upward, across.
OWN, UP, ACROSS, ROLL, YAW, PITCH = range(6)
_STRIDE = len(LINK_SLOTS)
#: A joint this near to Zw has Yw as its upward direction.
_STEEP = 0.9


@dataclass(frozen=True, repr=False)
class Directions(Brief):
    """Directions in which the joints' error motions are told."""

    in_base: Floats  # columns own axis, upward, across in the joint's base frame, shape (n_joints, 3, 3)
    along_beam: NDArray[np.int64]  # which of the three is nearest to the optical axis at nominal, shape (n_joints,)
    lever: Floats  # from the point of the data sheet to the mirror, in the base frame, in um, shape (n_joints, 3)
    in_world: Floats  # the same columns in the world at joint zero of the nominal cell, shape (n_joints, 3, 3)


def directions(cell: Cell, levers_mm: Floats) -> Directions:
    """Directions of each joint's error motions at joint zero of the nominal cell; levers in world axes."""
    vector = cell.parameters.nominal
    beam = chain.optical_axis(cell, vector).real
    bases = _frames(cell, vector, np.zeros((1, len(cell.joints)))).base[0]
    in_base, along, lever, in_world = [], [], [], []
    for base, arm in zip(bases, levers_mm, strict=True):
        own = base[:, 2]
        upward = np.array([0.0, 1.0, 0.0]) if abs(own[2]) > _STEEP else np.array([0.0, 0.0, 1.0])
        up = upward - own * (own @ upward)
        up /= np.linalg.norm(up)
        axes = np.column_stack([own, up, np.cross(own, up)])
        in_world.append(axes)
        in_base.append(base.T @ axes)
        along.append(int(np.argmax(np.abs(beam @ axes))))
        lever.append(base.T @ arm * 1e3)
    return Directions(np.array(in_base), np.array(along), np.array(lever), np.array(in_world))


@dataclass(frozen=True)
class Responses:
    """Derivatives of the cavity length at poses."""

    # by the displacements (um per um) and tilts (um per rad) of each joint, shape (n_poses, n_joints, 6)
    motion: Floats
    drive: Floats  # by the joint's own travel, shape (n_poses, n_joints)
    fibre: Floats  # by a displacement of the fibre in world axes, shape (n_poses, 3)
    length: Floats  # the cavity length itself, shape (n_poses,)


def responses(cell: Cell, vector: Floats, told: Directions, q: Floats, beam: Ints | None = None) -> Responses:
    """Derivatives of the cavity length by small motions at poses (n_poses, n_joints) seen by beams (n_poses,)."""
    if cell.further:
        whole = [np.empty((len(q), *shape)) for shape in ((q.shape[1], 6), (q.shape[1],), (3,), ())]
        for number, (view, index) in enumerate(cell.views):
            at = np.full(len(q), number == 0) if beam is None else beam == number
            part = responses(view, vector[index], told, q[at])
            for each, found in zip(whole, (part.motion, part.drive, part.fibre, part.length), strict=True):
                each[at] = found
        return Responses(*whole)
    frames = _frames(cell, vector, q)
    beta_et, theta_et, _, _, z_et, *fibre = vector[-len(EXTRINSICS) :]
    # Axes of the error motions in the world, shape (n_poses, n_joints, 3, 3), axis last.
    axes = np.swapaxes(frames.base @ told.in_base, -1, -2)
    arms = (frames.base @ told.lever[None, :, :, None])[..., 0]
    light = np.asarray(chain.optical_axis(cell, vector).real, dtype=np.float64)

    def made(across: Floats, tilted: Callable[[Floats], Floats], of_fibre: Floats, length: Floats) -> Responses:
        moved = (axes @ across[..., None])[..., 0]
        tilts, about_axis = tilted(frames.carried - arms), tilted(frames.pivot)[..., 0]
        # A joint that turns turns about its own axis, wherever the data sheet's point is.
        tilts[..., 0] = np.where(cell.revolute, about_axis, tilts[..., 0])
        drive = np.where(cell.revolute, tilts[..., 0], moved[..., 0])
        return Responses(np.concatenate([moved, tilts], axis=2), drive, of_fibre, length)

    if cell.target == "corner-cube":
        point = frames.origin + frames.tool @ np.array([beta_et, theta_et, z_et])
        away = point - fibre
        length = np.linalg.norm(away, axis=1) if cell.opd != "axis" else (away * light).sum(axis=1)
        beam_to = np.broadcast_to(light, away.shape) if cell.opd == "axis" else away / length[:, None]

        def turned_point(points: Floats) -> Floats:
            return np.asarray((axes @ np.cross(point[:, None] - points, beam_to[:, None])[..., None])[..., 0])

        return made(beam_to[:, None, :], turned_point, -beam_to, length)
    in_tool = np.array([np.sin(theta_et), -np.sin(beta_et) * np.cos(theta_et), np.cos(beta_et) * np.cos(theta_et)])
    normal = frames.tool @ in_tool
    distance = (((frames.origin + z_et * frames.tool[:, :, 2]) - fibre) * normal).sum(axis=1)
    if cell.opd == "axis":
        facing = normal @ light
        length, inverse = distance / facing, 1.0 / facing
        turned_beam = _cross(normal, light) * length[:, None]
    else:
        length, inverse = np.abs(distance), np.sign(distance)
        turned_beam = np.zeros_like(normal)

    across = normal[:, None] * inverse[:, None, None]

    def tilted(points: Floats) -> Floats:
        torque = _cross(normal[:, None], points - np.array(fibre)) - turned_beam[:, None]
        return np.asarray((axes @ (torque * inverse[:, None, None])[..., None])[..., 0])

    return made(across, tilted, -normal * inverse[:, None], length)


def pose_responses(cell: Cell, vector: Floats, told: Directions, q: Floats) -> list[Responses]:
    """Derivatives of place (x, z) and direction (x, y, z) of the mirror point of joint zero, in the fibre frame."""
    in_mirror = np.append(chain.reflection_point(cell, vector, np.zeros(len(cell.joints)))[1].real, 1.0)
    frames, fibre = _frames(cell, vector, q), chain.fibre_in_world(vector)[:3, :3].real
    points = (frames.origin + frames.tool @ (chain.mirror_in_tool(cell, vector).real @ in_mirror)[:3])[:, None]
    axes = np.swapaxes(frames.base @ told.in_base, -1, -2)
    centres = frames.carried - (frames.base @ told.lever[None, :, :, None])[..., 0]
    levers = np.repeat((points - centres)[:, :, None], 3, axis=2)
    revolute = cell.revolute
    levers[:, revolute, 0] = (points - frames.pivot)[:, revolute]
    moved = np.concatenate([axes, np.cross(axes, levers)], axis=2) @ fibre
    turned = np.concatenate([np.zeros_like(axes), axes], axis=2) @ fibre
    made = []
    for motion, of_fibre in [(moved[..., i], -fibre[:, i]) for i in (0, 2)] + [(turned[..., i], 0.0) for i in range(3)]:
        drive = np.where(revolute, motion[..., ROLL], motion[..., OWN])
        made.append(Responses(motion, drive, np.broadcast_to(of_fibre, (len(q), 3)), np.zeros(len(q))))
    return made


@dataclass(frozen=True)
class _Frames:
    """Base frames (n, n_joints, 3, 3), their origins and those of what is carried (n, n_joints, 3), and the tool's."""

    base: Floats
    pivot: Floats
    carried: Floats
    tool: Floats
    origin: Floats


def _frames(cell: Cell, vector: Floats, q: Floats) -> _Frames:
    n, n_joints = q.shape
    turn, at = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    base, pivot, carried = np.empty((n, n_joints, 3, 3)), np.empty((n, n_joints, 3)), np.empty((n, n_joints, 3))
    for i, joint in enumerate(cell.joints):
        beta, alpha, d, theta, r, gain, runout_cos, runout_sin = vector[_STRIDE * i : _STRIDE * (i + 1)]
        turn = turn @ (chain.rot_y(beta) @ chain.rot_x(alpha))[:3, :3].real
        at = at + d * turn[:, :, 0]
        base[:, i], pivot[:, i] = turn, at
        travel = q[:, i] * (1.0 + gain)
        angle, along = np.full(n, theta), np.full(n, r)
        if joint.kind == "prismatic":
            along += travel
        else:
            angle += travel
            along += runout_cos * np.cos(travel) + runout_sin * np.sin(travel)
        at = at + along[:, None] * turn[:, :, 2]
        carried[:, i] = at
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        x, y = turn[:, :, 0], turn[:, :, 1]
        turn = np.stack([c * x + s * y, c * y - s * x, turn[:, :, 2]], axis=2)
    return _Frames(base, pivot, carried, turn, at)


def _cross(a: Floats, b: Floats) -> Floats:
    """As `numpy.cross` of vectors (..., 3), whose checks take longer than its products."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
