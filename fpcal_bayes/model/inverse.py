"""The inverse geometric model (IGM): joint values at which a calibrated chain takes a pose.

Chains of three revolute and three prismatic joints in any order have a closed form for any parameter vector, so every
solution is found; other chains of six joints are solved by damped Newton steps from several starts, and a pose counts
as out of reach when none of them meets it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.inverse_few import FewJoints
from fpcal_bayes.model.kernels.inverse import OK, OUT_OF_REACH, SATURATED, SINGULAR, batch_inverse
from fpcal_bayes.model.kernels.pose import batch_tool_poses

__all__ = ["OK", "OUT_OF_REACH", "SATURATED", "SINGULAR", "InverseModel", "JointSolutions", "check_poses"]

#: A rotation matrix may miss orthonormality by this: what survives a file with seven digits.
ROTATION_TOLERANCE = 1e-6
#: Starts of Newton for a chain without closed form; farthest starts of joints without limit, in rad and um.
_STARTS = 64
_FAR_TURN, _FAR_TRAVEL = np.pi, 1000.0


@dataclass(frozen=True)
class JointSolutions:
    """Joint values of poses, and what became of each pose; nothing is clipped: drive to those that are `ok` only."""

    cell: Cell  # whose joints they are
    q: Floats  # shape (..., n_joints), in um and rad; beyond a limit where saturated, NaN where out of reach
    status: Ints  # `OK`, `OUT_OF_REACH`, `SATURATED` or `SINGULAR`, shape (...)
    joint: Ints  # the one farthest beyond its limit where a pose is saturated, else -1, shape (...)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Whether each pose can be driven to, shape (...)."""
        return np.asarray(self.status == OK)

    def texts(self) -> NDArray[np.str_]:
        """The status of each pose in words, shape (...): ``ok``, or the reason why it cannot be driven to."""
        flat = zip(self.status.flat, self.joint.flat, self.q.reshape(-1, self.q.shape[-1]), strict=True)
        texts = [self._text(int(status), int(joint), q) for status, joint, q in flat]
        return np.array(texts, dtype=np.str_).reshape(self.status.shape)

    def _text(self, status: int, number: int, q: Floats) -> str:
        if status == OK:
            return "ok"
        if status == OUT_OF_REACH:
            return "out of reach"
        if status == SINGULAR:
            return "singular: the pose does not determine the joints"
        joint, scale = self.cell.joints[number], self.cell.joint_scales[number]
        side, limit = ("lower", joint.low) if q[number] < joint.low else ("upper", joint.high)
        wanted = f"{q[number] / scale:.6g} {joint.unit} wanted"
        return f"saturated: q{number + 1} at its {side} limit {limit / scale:g} {joint.unit} ({wanted})"


@dataclass(frozen=True)
class InverseModel:
    """The inverse geometric model of a cell with six joints, or with fewer: in the directions that exist."""

    cell: Cell  # gives kinds and limits of the joints

    def __post_init__(self) -> None:
        n, n_prismatic = len(self.cell.joints), int(np.count_nonzero(~self.cell.revolute))
        if n > 6:
            raise InputError(
                f"cell {self.cell.name!r} has {n} joints: a pose has six degrees of freedom, so that the inverse "
                "model, tasks and control need a cell with six or fewer"
            )
        if n == 6 and n_prismatic > 3:
            raise InputError(
                f"cell {self.cell.name!r} has {n_prismatic} prismatic joints: with fewer than three revolute ones an "
                "orientation cannot be commanded, expected at most three prismatic joints"
            )

    @cached_property
    def home(self) -> Floats:
        """Middle of the limits of each joint, zero where there is none, shape (n_joints,)."""
        low, high = self.cell.low, self.cell.high
        bounded = np.isfinite(low) & np.isfinite(high)
        with np.errstate(invalid="ignore"):
            return np.where(bounded, (low + high) / 2.0, np.clip(0.0, low, high))

    @cached_property
    def closed_form(self) -> bool:
        """Whether the chain has a closed form, so that every solution is found."""
        return len(self.cell.joints) == 6 and int(np.count_nonzero(self.cell.revolute)) == 3

    @cached_property
    def _starts(self) -> Floats:
        """Where Newton begins, shape (n_starts, n_joints); the same on every run."""
        far = np.where(self.cell.revolute, _FAR_TURN, _FAR_TRAVEL)
        low = np.where(np.isfinite(self.cell.low), self.cell.low, -far)
        high = np.where(np.isfinite(self.cell.high), self.cell.high, far)
        if self.closed_form:
            return np.empty((0, len(low)))
        return np.random.default_rng(0).uniform(low, high, (_STARTS, len(low)))

    def tool_poses(self, vectors: Floats, q: Floats) -> Floats:
        """DGM: tool frames wTe (n_poses, 4, 4) of joint vectors, with an axis n_vectors in front as in `vectors`."""
        many = np.ascontiguousarray(np.atleast_2d(vectors), dtype=float)
        if many.shape[1] != len(self.cell.parameters) or np.shape(q)[-1] != len(self.cell.joints):
            raise ValueError(
                f"model vectors {np.shape(vectors)} and joint vectors {np.shape(q)}: expected rows of "
                f"{len(self.cell.parameters)} and {len(self.cell.joints)}"
            )
        joints = np.ascontiguousarray(q if np.ndim(q) == 3 else q[None], dtype=float)
        poses = batch_tool_poses(many, self.cell.revolute, joints)
        return poses[0] if np.ndim(vectors) == 1 else poses

    def solve(
        self, vectors: Floats, poses: Floats, *, near: Floats | None = None, follow: bool = False
    ) -> JointSolutions:
        """IGM: joint values at which the tool frame takes `poses` wTe, shape (..., 4, 4), by one or many model vectors.

        near: the nearest of several solutions is taken, by default to `home`; follow: each near the pose before it.
        Shaped as `poses` without its last two axes, with a leading axis n_vectors where `vectors` has one.
        """
        check_poses(poses)
        near = self.home if near is None else np.ascontiguousarray(near, dtype=float)
        many = np.ascontiguousarray(np.atleast_2d(vectors), dtype=float)
        targets = np.ascontiguousarray(poses, dtype=float).reshape((1,) * (4 - np.ndim(poses)) + np.shape(poses))
        cell = self.cell
        if len(cell.joints) < 6:
            all_targets = np.broadcast_to(targets, (len(many), *targets.shape[1:]))
            parts = [FewJoints.of(cell, v).solve(t, near) for v, t in zip(many, all_targets, strict=True)]
            q, status, joint = (np.stack(part) for part in zip(*parts, strict=True))
        else:
            limits = cell.revolute, cell.low, cell.high
            q, status, joint = batch_inverse(many, limits, targets, near, follow, self._starts, -1)
        if np.ndim(poses) == 2:
            q, status, joint = q[:, 0], status[:, 0], joint[:, 0]
        if np.ndim(vectors) == 1:
            q, status, joint = q[0], status[0], joint[0]
        return JointSolutions(cell, q, np.asarray(status), np.asarray(joint))

    def missed(self, vector: Floats, poses: Floats, q: Floats) -> Floats:
        """What joint values leave undone of poses (n_poses, 4, 4), as `FewJoints.missed`; zero for six joints."""
        if len(self.cell.joints) == 6:
            return np.zeros((len(poses), 6))
        return FewJoints.of(self.cell, vector).missed(poses, q)


def check_poses(poses: ArrayLike) -> None:
    """Raise `InputError` at the first of `poses` (..., 4, 4) that is no pose, naming it by its number from 1."""
    stack = np.asarray(poses, dtype=float)
    if stack.shape[-2:] != (4, 4):
        raise InputError(f"a pose has shape {stack.shape[-2:]}, expected a 4 x 4 transform")
    stack = stack.reshape(-1, 4, 4)
    turns = stack[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        missed = np.abs(turns @ np.swapaxes(turns, 1, 2) - np.eye(3)).max(axis=(1, 2))
        good = (missed <= ROTATION_TOLERANCE) & (np.linalg.det(turns) > 0) & np.isfinite(stack[:, :3, 3]).all(axis=1)
    good &= (stack[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    if not good.all():
        what = "expected finite numbers, an orthonormal right-handed rotation and the last row 0 0 0 1"
        raise InputError(f"pose {np.argmin(good) + 1}: {what}")
