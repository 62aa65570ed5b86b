"""Where the axes of a cell point, and how mirror and fibre face each other, at one joint vector."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.joints import JointKind
from fpcal_bayes.model.parameters import LINK_SLOTS

_STRIDE = len(LINK_SLOTS)
#: A direction within this of a world axis is said to be along it, in rad.
ALONG = float(np.radians(0.05))


@dataclass(frozen=True)
class Sight:
    """Mirror and fibre at one joint vector, in the world frame; lengths in um, angles in rad."""

    normal: Floats  # Zt of the mirror, shape (3,)
    across: Floats  # Xt of the mirror, shape (3,)
    origin: Floats  # of the mirror, shape (3,)
    light: Floats  # direction of the light that leaves the fibre, shape (3,)
    fibre_x: Floats  # Xf, shape (3,)
    fibre: Floats  # the fibre's end, shape (3,)
    point: Floats  # reflection point, shape (3,); not finite where the light runs along the mirror
    point_on_mirror: Floats  # the same in the mirror frame
    length: float  # along the light to the mirror plane: below zero behind the fibre, infinite along the mirror
    tilt: float  # between the light and the normal turned round: 0 where the mirror faces the fibre, pi its back


def joint_axes(cell: Cell, vector: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Direction of each joint's positive motion or right-hand turn, and a point of its axis, (n_joints, 3) each."""
    poses = [np.eye(4)]
    for i, joint in enumerate(cell.joints):
        link = vector[_STRIDE * i : _STRIDE * (i + 1)]
        poses.append(poses[-1] @ chain.link_transform(link, q[i], joint.kind == "prismatic"))
    found = np.array(poses[1:])
    return found[:, :3, 2].copy(), found[:, :3, 3].copy()


def sight(cell: Cell, vector: Floats, q: Floats) -> Sight:
    """How mirror and fibre stand to each other at joint vector `q`; arguments as those of `joint_axes`."""
    mirror, fibre = chain.mirror_pose(cell, vector, q), chain.fibre_in_world(vector)
    normal, origin, light = mirror[:3, 2], mirror[:3, 3], chain.optical_axis(cell, vector)
    facing, distance = float(-normal @ light), float(-normal @ (origin - fibre[:3, 3]))
    seen = abs(facing) > 1e-12
    length = distance / facing if seen else np.inf
    point = fibre[:3, 3] + light * length if seen else np.full(3, np.nan)
    tilt = float(np.arctan2(np.linalg.norm(np.cross(normal, light)), facing))
    on_mirror = mirror[:3, :3].T @ (point - origin)
    return Sight(normal, mirror[:3, 0], origin, light, fibre[:3, 0], fibre[:3, 3], point, on_mirror, length, tilt)


def home(cell: Cell) -> Floats:
    """Joint vector zero, or as near to it as the limits allow, shape (n_joints,)."""
    return np.clip(np.zeros(len(cell.joints)), cell.low, cell.high)


def direction_words(direction: Floats) -> str:
    """A direction in words: ``+z``, or ``+z, 3.2 deg off it towards -x``."""
    size = np.abs(direction)
    along = int(np.argmax(size))
    main = _signed(direction, along)
    off = float(np.arctan2(np.linalg.norm(np.delete(direction, along)), size[along]))
    if off < ALONG:
        return main
    rest = size.copy()
    rest[along] = 0.0
    towards = [_signed(direction, i) for i in np.argsort(-rest)[:2] if rest[i] > np.sin(ALONG)]
    return f"{main}, {np.degrees(off):.3g} deg off it towards {' and '.join(towards) or 'another axis'}"


def axis_words(kind: JointKind, direction: Floats) -> str:
    """What an axis does: ``moves along +x``, ``turns about -z``."""
    return f"{'moves along' if kind == 'prismatic' else 'turns about'} {direction_words(direction)}"


def _signed(direction: Floats, axis: int) -> str:
    return f"{'+' if direction[axis] > 0 else '-'}{'xyz'[axis]}"
