"""The inverse model of a chain of fewer than six joints: a pose is met in the directions that exist.

The directions are those of the fibre frame at the mirror point: shifts along Xf, Yf, Zf, turns about them. The nominal
joints at zero decide which of them can be met, as many as there are joints; what a pose asks for in the others stays as
it is, and `missed` says how much that is.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import Rotation

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.inverse import OK, OUT_OF_REACH, SATURATED, SINGULAR
from fpcal_bayes.model.kernels.pose import batch_tool_poses

#: Um that count as much as a radian when directions are told apart.
LEVER = 1000.0
#: Steps of Newton, how near they come in um, the step of derivatives in um and rad, the least of a direction.
_STEPS, _GOAL, _STEP, _LEAST = 14, 1e-7, 1e-4, 1e-3


@dataclass(frozen=True)
class FewJoints:
    """Solves poses for one model vector of a cell."""

    cell: Cell
    vector: Floats  # its model vector, shape (model size,)
    met: Ints  # positions of the directions that are met, x y z rx ry rz of the fibre frame, shape (n_met,)
    fibre: Floats  # rotation of the fibre frame in the world, shape (3, 3)
    point: Floats  # frame at the mirror point, in the tool, shape (4, 4)

    @classmethod
    def of(cls, cell: Cell, vector: Floats) -> "FewJoints":
        """The directions of a model vector (model size,)."""
        home = np.clip(np.zeros(len(cell.joints)), cell.low, cell.high)
        nominal = cls._seen(cell, cell.parameters.nominal, np.arange(6))
        # A radian of a joint counts as much as `LEVER` um of another.
        jacobian = nominal._jacobian(home[None])[0] * np.where(cell.revolute, 1.0, LEVER)
        _, triangle, order = qr(jacobian.T, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(triangle))
        return cls._seen(cell, vector, np.sort(order[: np.count_nonzero(sizes > _LEAST * sizes[0])]))

    @classmethod
    def _seen(cls, cell: Cell, vector: Floats, met: Ints) -> "FewJoints":
        _, on_mirror = chain.reflection_point(cell, vector, np.zeros(len(cell.joints)))
        point = chain.mirror_in_tool(cell, vector) @ chain.translation(*on_mirror)
        return cls(cell, vector, met, chain.fibre_in_world(vector)[:3, :3], point)

    def solve(self, targets: Floats, near: Floats) -> tuple[Floats, Ints, Ints]:
        """Joint values (n_poses, n_joints), status and saturated joint (n_poses,) of tool poses (n_poses, 4, 4)."""
        cell = self.cell
        q = np.tile(near, (len(targets), 1))
        status = np.full(len(q), SINGULAR if len(self.met) < len(cell.joints) else OUT_OF_REACH, dtype=np.int64)
        for _ in range(_STEPS):
            error = self._twists(self._poses(q), targets)[:, self.met]
            met = np.abs(error).max(axis=1) < _GOAL
            status[met & (status == OUT_OF_REACH)] = OK
            if met.all():
                break
            q = q + np.einsum("pij,pj->pi", np.linalg.pinv(self._jacobian(q)[:, self.met]), error)
            # A turn never needs more than a whole one.
            q = np.where(cell.revolute, np.clip(q, -2 * np.pi, 2 * np.pi), q)
        q[status == OUT_OF_REACH] = np.nan
        slack = 1e-9 * (1.0 + np.abs(q))
        beyond = np.maximum(cell.low - slack - q, q - cell.high - slack) / np.where(cell.revolute, 1.0, LEVER)
        joint = np.where((status == OK) & (beyond > 0).any(axis=1), beyond.argmax(axis=1), -1).astype(np.int64)
        status[joint >= 0] = SATURATED
        return q, status, joint

    def missed(self, targets: Floats, q: Floats) -> Floats:
        """What joint values leave undone of tool poses (n_poses, 4, 4), in um, turns times `LEVER`; (n_poses, 6)."""
        error = self._twists(self._poses(q), targets)
        error[:, self.met] = 0.0
        return error

    def _poses(self, q: Floats) -> Floats:
        vectors, joints = (np.ascontiguousarray(a, dtype=float)[None] for a in (self.vector, q))
        return np.asarray(batch_tool_poses(vectors, self.cell.revolute, joints)[0])

    def _twists(self, start: Floats, end: Floats) -> Floats:
        """Shift and turn of the mirror point between tool frames (n, 4, 4), in fibre axes; um, rad times `LEVER`."""
        start, end = start @ self.point, end @ self.point
        good = np.isfinite(start).all(axis=(1, 2))
        turns = np.full((len(start), 3), np.nan)
        turns[good] = Rotation.from_matrix(end[good, :3, :3] @ np.swapaxes(start[good, :3, :3], 1, 2)).as_rotvec()
        return np.hstack([(end[:, :3, 3] - start[:, :3, 3]) @ self.fibre, LEVER * turns @ self.fibre])

    def _jacobian(self, q: Floats) -> Floats:
        """Twists by each joint, shape (n_poses, 6, n_joints)."""
        steps = _STEP * np.eye(q.shape[1])
        columns = [self._twists(self._poses(q - step), self._poses(q + step)) / (2.0 * _STEP) for step in steps]
        return np.stack(columns, axis=-1)
