"""The inverse model of a chain of fewer than six joints: a pose is met in the directions that exist.

At joint zero the joints move the tool in as many directions as there are joints. A pose is solved for in these; what it
asks for in the others stays as it is, and `missed` says how much that is.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.inverse import OK, OUT_OF_REACH, SATURATED, SINGULAR
from fpcal_bayes.model.kernels.pose import batch_tool_poses

#: Um that count as much as a radian when directions are told apart.
LEVER = 1000.0
#: Steps of Newton, how near they come in um, the step of derivatives in um and rad, the least of a direction.
_STEPS, _GOAL, _STEP, _LEAST = 14, 1e-7, 1e-4, 1e-3


@dataclass(frozen=True)
class FewJoints:
    """Solves poses for one model vector of a cell.

    Attributes
    ----------
    cell, vector
        The cell, and its model vector, shape (model size,).
    directions
        Orthonormal twists that the joints can make at joint zero, shape (6, n_directions): translations in um, turns
        in rad times `LEVER`.
    """

    cell: Cell
    vector: Floats
    directions: Floats

    @classmethod
    def of(cls, cell: Cell, vector: Floats) -> "FewJoints":
        """The directions of a model vector (model size,)."""
        home = np.clip(np.zeros(len(cell.joints)), cell.low, cell.high)
        jacobian = _jacobian(cell, vector, home[None])[0]
        # A radian of a joint counts as much as `LEVER` um of another.
        left, sizes, _ = np.linalg.svd(jacobian * np.where(cell.revolute, 1.0, LEVER), full_matrices=False)
        return cls(cell, vector, left[:, sizes > _LEAST * sizes[0]])

    def solve(self, targets: Floats, near: Floats) -> tuple[Floats, Ints, Ints]:
        """Joint values (n_poses, n_joints), status and saturated joint (n_poses,) of tool poses (n_poses, 4, 4)."""
        cell = self.cell
        q = np.tile(near, (len(targets), 1))
        status = np.full(len(targets), OUT_OF_REACH, dtype=np.int64)
        if self.directions.shape[1] < len(cell.joints):
            status[:] = SINGULAR
        for _ in range(_STEPS):
            error = self._error(targets, q) @ self.directions
            met = np.abs(error).max(axis=1) < _GOAL
            status[met & (status == OUT_OF_REACH)] = OK
            if met.all():
                break
            matrix = np.swapaxes(_jacobian(cell, self.vector, q), 1, 2) @ self.directions
            q = q + np.einsum("pji,pj->pi", np.linalg.pinv(matrix), error)
            # A turn never needs more than a whole one.
            q = np.where(cell.revolute, np.clip(q, -2 * np.pi, 2 * np.pi), q)
        q[status == OUT_OF_REACH] = np.nan
        scale = np.where(cell.revolute, 1.0, LEVER)
        slack = 1e-9 * (1.0 + np.abs(q))
        beyond = np.maximum(cell.low - slack - q, q - cell.high - slack) / scale
        joint = np.where((status == OK) & (beyond > 0).any(axis=1), beyond.argmax(axis=1), -1).astype(np.int64)
        status[joint >= 0] = SATURATED
        return q, status, joint

    def missed(self, targets: Floats, q: Floats) -> Floats:
        """What joint values `q` (n_poses, n_joints) leave undone of tool poses (n_poses, 4, 4), shape (n_poses, 6).

        In um, turns in rad times `LEVER`.
        """
        error = self._error(targets, q)
        left: Floats = error - error @ self.directions @ self.directions.T
        return left

    def _error(self, targets: Floats, q: Floats) -> Floats:
        """Twists from where joints `q` put the tool to `targets`, shape (n_poses, 6)."""
        return _twists(_poses(self.cell, self.vector, q), targets)


def _poses(cell: Cell, vector: Floats, q: Floats) -> Floats:
    poses: Floats = batch_tool_poses(
        np.ascontiguousarray(vector, dtype=float)[None], cell.revolute, np.ascontiguousarray(q, dtype=float)[None]
    )[0]
    return poses


def _twists(start: Floats, end: Floats) -> Floats:
    """Shift and turn from poses to others (n, 4, 4), in um and rad times `LEVER`; shape (n, 6)."""
    good = np.isfinite(start).all(axis=(1, 2))
    turns = np.zeros((len(start), 3))
    turned = end[good, :3, :3] @ np.swapaxes(start[good, :3, :3], 1, 2)
    turns[good] = Rotation.from_matrix(turned).as_rotvec()
    twists: Floats = np.hstack([end[:, :3, 3] - start[:, :3, 3], LEVER * turns])
    return twists


def _jacobian(cell: Cell, vector: Floats, q: Floats) -> Floats:
    """Twists by each joint, shape (n_poses, 6, n_joints)."""
    columns = []
    for i in range(q.shape[1]):
        step = np.zeros(q.shape[1])
        step[i] = _STEP
        twists = _twists(_poses(cell, vector, q - step), _poses(cell, vector, q + step))
        columns.append(twists / (2.0 * _STEP))
    return np.stack(columns, axis=-1)
