"""Where the mirror stands while it is controlled: the scheme of the paper's Fig 7 for one or many model vectors.

The operational pose X is that of the mirror frame placed at the reflection point; with extrinsics eTt and wTf and the
reflection point tPr in the mirror frame, a pose fX that is commanded in the fibre frame asks of the robot

    wTe = wTf fX (eTt tTPr)^-1,    q = IGM(wTe).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell


@dataclass(frozen=True)
class Placement:
    """Frames of a model vector that a command in the fibre frame needs."""

    fibre: Floats  # wTf, shape (4, 4)
    tool_in_point: Floats  # (eTt tTPr)^-1: the tool in the mirror frame placed at the reflection point, shape (4, 4)
    #: fX of the aligned pose, shape (4, 4): mirror normal against the light, Xt along Xf, the mirror point that
    #: reflects at joint vector zero where it reflects there.
    aligned: Floats

    @classmethod
    def of(cls, cell: Cell, vector: Floats) -> "Placement":
        """Frames of the model vector `vector` (model size,), in um and rad."""
        if cell.target != "plane-mirror":
            raise InputError(
                f"cell {cell.name!r}: tasks hold a mirror before the first beam, which ends on a {cell.target}; put a "
                "beam on a plane mirror first"
            )
        world, mirror = chain.reflection_point(cell, vector, np.zeros(len(cell.joints)))
        fibre = chain.fibre_in_world(vector)
        point = chain.mirror_in_tool(cell, vector) @ chain.translation(*mirror)
        aligned = np.eye(4)
        # The light leaves along -Yf, or along Zf in the literal reading of the paper's (13).
        aligned[:3, :3] = chain.rot_x(-np.pi / 2 if cell.optical_axis == "minus-y" else np.pi)[:3, :3]
        aligned[:3, 3] = fibre[:3, :3].T @ (world - fibre[:3, 3])
        return cls(fibre, _inverse(point), aligned)

    def moved(self, offsets: Floats) -> Floats:
        """Poses fX (n, 4, 4) by `offsets` (n, 6) away: um along Xf, Yf, Zf, turns in rad about Xf, then Yf, then Zf."""
        poses = np.zeros((len(offsets), 4, 4))
        poses[:, :3, :3] = turns(offsets[:, 3:]) @ self.aligned[:3, :3]
        poses[:, :3, 3] = self.aligned[:3, 3] + offsets[:, :3]
        poses[:, 3, 3] = 1.0
        return poses

    def offsets(self, poses: Floats) -> Floats:
        """Moves (n, 6) away from the aligned pose that give poses fX (n, 4, 4), as `moved` takes them."""
        turned = Rotation.from_matrix(poses[:, :3, :3] @ self.aligned[:3, :3].T)
        return np.hstack([poses[:, :3, 3] - self.aligned[:3, 3], turned.as_euler("xyz")])

    def tool_poses(self, poses: Floats) -> Floats:
        """Tool frames wTe of poses fX (..., 4, 4); same shape."""
        return np.asarray(self.fibre @ poses @ self.tool_in_point)

    def mirror_poses(self, tools: Floats) -> Floats:
        """Poses fX of tool frames wTe (..., 4, 4); same shape."""
        return np.asarray(_inverse(self.fibre) @ tools @ _inverse(self.tool_in_point))


def turns(angles: Floats) -> Floats:
    """Rotations Rz(c) Ry(b) Rx(a) of `angles` (n, 3) in rad: about fixed axes, X first; shape (n, 3, 3)."""
    ca, cb, cc = np.cos(angles).T
    sa, sb, sc = np.sin(angles).T
    rows = [
        [cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa],
        [sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa],
        [-sb, cb * sa, cb * ca],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), -1, 0))


def _inverse(transform: Floats) -> Floats:
    result = np.eye(4)
    result[:3, :3] = transform[:3, :3].T
    result[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return result
