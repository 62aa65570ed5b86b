"""The cavity model: lengths, their changes and their derivatives, for one cell and one choice of free parameters.

Poses are laid out for the kernels once: those that differ in prismatic joints alone share their rotations.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.jacobian import batch_jacobians, derivative_columns
from fpcal_bayes.model.kernels.lengths import RUNOUT_COS, STRIDE, THETA, R, batch_lengths
from fpcal_bayes.model.kernels.mirror import batch_mirrors
from fpcal_bayes.model.parameters import ParameterSet


@dataclass(frozen=True)
class PoseGroups:
    """Distinct poses, sorted by group."""

    q: Floats  # distinct joint vectors, shape (n_poses, n_joints), in um and rad
    #: group_q, group_cos, group_sin: Joint values of each group and their cosines and sines, shape (n_groups,
    #: n_joints); zero, one, zero at prismatic joints.
    group_q: Floats
    group_cos: Floats
    group_sin: Floats
    group_start: Ints  # poses of group g are ``group_start[g]`` to ``group_start[g + 1]``, shape (n_groups + 1,)
    prismatic_q: Floats  # values of the prismatic joints, in the chain's order, shape (n_poses, n_prismatic)
    inverse: Ints  # where each joint vector that was given stands among the distinct ones, shape (n_given,)

    @property
    def n_groups(self) -> int:
        """Number of distinct revolute joint vectors."""
        return len(self.group_q)


def group_poses(cell: Cell, q: Floats) -> PoseGroups:
    """Lay out joint vectors `q`, shape (n, n_joints) in um and rad, for the kernels."""
    q = np.ascontiguousarray(q, dtype=float)
    if q.ndim != 2 or q.shape[1] != len(cell.joints):
        raise ValueError(f"joint vectors have shape {q.shape}, expected (n, {len(cell.joints)})")
    turns = np.flatnonzero(cell.revolute)
    order = np.concatenate([turns, np.flatnonzero(~cell.revolute)])
    # Sorted by the revolute joints first, so that the poses of a group follow each other.
    place = np.lexsort(q[:, order[::-1]].T)
    new, new_group = (_changes(q[np.ix_(place, part)]) for part in (order, turns))
    inverse = np.empty(len(q), dtype=np.int64)
    inverse[place] = np.cumsum(new) - 1
    distinct = q[place[new]]
    group_start = np.flatnonzero(new_group[new])
    group_q = np.where(cell.revolute, distinct, 0.0)[group_start]
    return PoseGroups(
        q=distinct,
        group_q=group_q,
        group_cos=np.cos(group_q),
        group_sin=np.sin(group_q),
        group_start=np.append(group_start, len(distinct)).astype(np.int64),
        prismatic_q=np.ascontiguousarray(distinct[:, ~cell.revolute]),
        inverse=inverse,
    )


def _changes(rows: Floats) -> Bools:
    """Whether each row differs from the one before it, shape (n,); the first does."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    return new


#: What the kernels of lengths and of derivatives take first, in the order of `batch_lengths`.
_Arguments = tuple[Floats, Ints, Floats, int, bool, Bools, Floats, Floats, Floats, Ints, Floats, Ints, Ints]


@dataclass(frozen=True)
class Rows:
    """Rows to predict, laid out for the kernels: each is L(end) - L(start), or L(end) where start is -1."""

    poses: PoseGroups
    starts: Ints
    ends: Ints


@dataclass(frozen=True)
class CavityModel:
    """Cavity length of a cell as a function of its free parameters."""

    cell: Cell  # the cell, which also says along which path light is counted
    free: ParameterSet  # parameters that `values` hold, in this order
    held: Floats  # model vector of the parameters that are not free, shape (model size,), in um and rad

    @classmethod
    def of(cls, cell: Cell, free: ParameterSet | None = None, held: Floats | None = None) -> "CavityModel":
        """The model of `cell`; by default the cell's own free parameters, the others at nominal."""
        return cls(cell, cell.free if free is None else free, cell.parameters.nominal if held is None else held)

    side: int = 0  # 1 or -1: perpendicular lengths change sign where the mirror passes the fibre, without a kink

    @cached_property
    def _path(self) -> int:
        return 0 if self.cell.opd == "axis" else 2 * self.side or 1

    def facing(self, values: Floats, rows: Rows) -> "CavityModel":
        """The model whose perpendicular lengths are smooth, the mirror standing as at free parameters `values` (n,)."""
        if self.cell.opd == "axis":
            return self
        poses = Rows(rows.poses, np.full(len(rows.poses.q), -1, dtype=np.int64), np.arange(len(rows.poses.q)))
        ahead = replace(self, side=1).predict(values, poses) > 0
        return replace(self, side=1 if ahead.all() else 0 if ahead.any() else -1)

    @cached_property
    def _axis_is_z(self) -> bool:
        return self.cell.optical_axis == "z"

    @cached_property
    def _columns(self) -> Ints:
        return derivative_columns(self.cell.revolute, self.free.slots)

    def vector(self, values: Floats) -> Floats:
        """Model vector (model size,) with the free parameters at `values` (n,); or of many of them, (n_vectors, n)."""
        vector = np.broadcast_to(self.held, (*np.shape(values)[:-1], len(self.held))).copy()
        vector[..., self.free.slots] = values
        return vector

    def rows(self, q_start: Floats, q_end: Floats, absolute: Bools | None = None) -> Rows:
        """Lay out sweeps for the kernels.

        q_start, q_end: joint vectors, shape (n_rows, n_joints), in um and rad.
        absolute: rows that give L(end) itself, shape (n_rows,).
        """
        poses = group_poses(self.cell, np.concatenate([q_start, q_end]))
        starts, ends = np.split(poses.inverse, 2)
        if absolute is not None:
            starts = np.where(absolute, -1, starts)
        return Rows(poses, np.ascontiguousarray(starts), np.ascontiguousarray(ends))

    def turned(self, rows: Rows, way: Floats) -> Rows:
        """The rows with each joint counted the other way where `way`, shape (n_joints,), is -1 in place of 1."""
        poses, along = rows.poses, way[~self.cell.revolute]
        turned = {name: getattr(poses, name) * way for name in ("q", "group_q", "group_sin")}
        return replace(rows, poses=replace(poses, **turned, prismatic_q=poses.prismatic_q * along))

    def pose_rows(self, q: Floats) -> Rows:
        """Lay out poses `q` (n, n_joints) whose cavity length itself is wanted."""
        poses = group_poses(self.cell, q)
        return Rows(poses, np.full(len(q), -1, dtype=np.int64), poses.inverse)

    def predict(self, values: Floats, rows: Rows) -> Floats:
        """Predict rows for one or many parameter vectors.

        values: free parameters in um and rad, shape (n,) or (n_vectors, n).
        rows: from `rows` or `pose_rows`.
        Returns shape (n_rows,) or (n_vectors, n_rows), in um.
        """
        many = np.ascontiguousarray(np.atleast_2d(values), dtype=float)
        result = batch_lengths(*self._arguments(many, rows))
        return result[0] if np.ndim(values) == 1 else result

    def predict_with_jacobian(self, values: Floats, rows: Rows) -> tuple[Floats, Floats]:
        """Predict rows with their derivatives by the free parameters.

        Returns predictions (n_rows,) and derivatives (n_rows, n), each with a leading axis n_vectors where `values` has
        one; in um, and um per um or rad.
        """
        many = np.ascontiguousarray(np.atleast_2d(values), dtype=float)
        result, jacobian = batch_jacobians(*self._arguments(many, rows), self._columns)
        return (result[0], jacobian[0]) if np.ndim(values) == 1 else (result, jacobian)

    def joint_jacobian(self, values: Floats, q: Floats) -> Floats:
        """Derivatives of the cavity length by the joints.

        values: free parameters, shape (n,).
        q: joint vectors, shape (n_poses, n_joints).
        Returns shape (n_poses, n_joints), in um per um or rad.
        """
        n_joints = len(self.cell.joints)
        links = np.arange(n_joints) * STRIDE
        wanted = np.concatenate([links + np.where(self.cell.revolute, THETA, R), links + R]).astype(np.int64)
        many = np.ascontiguousarray(values, dtype=float)[None]
        asked = derivative_columns(self.cell.revolute, wanted)
        _, columns = batch_jacobians(*self._arguments(many, self.pose_rows(q)), asked)
        moved, along = columns[0][:, :n_joints], columns[0][:, n_joints:]
        link_values = self.vector(values)[: STRIDE * n_joints].reshape(n_joints, STRIDE)
        gain, runout_cos, runout_sin = link_values[:, RUNOUT_COS - 1 :].T
        turned = q * (1.0 + gain)
        climb = np.where(self.cell.revolute, runout_sin * np.cos(turned) - runout_cos * np.sin(turned), 0.0)
        return np.asarray((moved + climb * along) * (1.0 + gain))

    def mirrors(self, values: Floats, q: Floats) -> tuple[Floats, Floats]:
        """Mirror normals and origins in the world frame, columns three and four of wTt.

        values: free parameters, shape (n,) or (n_vectors, n).
        q: joint vectors, shape (n_poses, n_joints).
        Returns normals and origins, each of shape (n_poses, 3), with a leading axis n_vectors where `values` has one.
        """
        many = np.ascontiguousarray(np.atleast_2d(values), dtype=float)
        joints = np.ascontiguousarray(q, dtype=float)
        normals, origins = batch_mirrors(self.held, self.free.slots, many, self.cell.revolute, joints)
        return (normals[0], origins[0]) if np.ndim(values) == 1 else (normals, origins)

    def reflection_points(self, values: Floats, q: Floats) -> tuple[Floats, Floats]:
        """Reflection points wPr and tPr, paper equations (28), (29), for poses `q`; each of shape (n_poses, 3)."""
        vector = self.vector(values)
        points = [chain.reflection_point(self.cell, vector, pose) for pose in q]
        return np.array([w for w, _ in points]), np.array([t for _, t in points])

    def reflection_sd(self, values: Floats, covariance: Floats, q: Floats) -> tuple[Floats, Floats]:
        """Standard deviations of the coordinates of wPr and tPr, to first order.

        values, covariance: free parameters and their covariance in um and rad, shapes (n,) and (n, n).
        q: one joint vector, shape (n_joints,).
        Returns each of shape (3,), in um.
        """
        vector = self.vector(values).astype(complex)
        step = 1e-30
        columns = []
        for slot in self.free.slots:
            shifted = vector.copy()
            shifted[slot] += 1j * step
            columns.append(np.concatenate(chain.reflection_point(self.cell, shifted, q)).imag / step)
        jacobian = np.array(columns).T
        sd = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian))
        return sd[:3], sd[3:]

    def _arguments(self, values: Floats, rows: Rows) -> _Arguments:
        poses = rows.poses
        return (
            self.held,
            self.free.slots,
            values,
            self._path,
            self._axis_is_z,
            self.cell.revolute,
            poses.group_q,
            poses.group_cos,
            poses.group_sin,
            poses.group_start,
            poses.prismatic_q,
            rows.starts,
            rows.ends,
        )
