"""The cavity model: lengths, their changes and their derivatives, for one cell and one choice of free parameters.

Poses are laid out for the kernels once: those that differ in prismatic joints alone share their rotations.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.jacobian import batch_jacobians, derivative_columns
from fpcal_bayes.model.kernels.lengths import (
    GAIN,
    LANES,
    RUNOUT_COS,
    STRIDE,
    THETA,
    Question,
    R,
    batch_lengths,
    batch_mirrors,
    few_vector_lengths,
)
from fpcal_bayes.model.kernels.point import batch_points, point_columns
from fpcal_bayes.model.kernels.pull import joint_pulls
from fpcal_bayes.model.parameters import ParameterSet

#: Rows of a block: what a kernel holds of each pose of one stays in the cache.
_BLOCK = 4096


@dataclass(frozen=True, repr=False)
class PoseGroups(Brief):
    """Distinct poses, sorted by group."""

    group_q: Floats  # joint values of each group, (n_groups, n_joints), in um and rad, zero where prismatic
    group_cos: Floats  # their cosines
    group_sin: Floats  # their sines
    group_start: Ints  # poses of group g are ``group_start[g]`` to ``group_start[g + 1]``, shape (n_groups + 1,)
    prismatic_q: Floats  # values of the prismatic joints, in the chain's order, shape (n_poses, n_prismatic)
    inverse: Ints  # where each joint vector that was given stands among the distinct ones, shape (n_given,)


def joint_vectors(cell: Cell, q: Floats) -> Floats:
    """Joint vectors as the kernels read them, which look at no shape; raises ValueError where it is another one."""
    q = np.ascontiguousarray(q, dtype=float)
    if q.ndim != 2 or q.shape[1] != len(cell.joints):
        raise ValueError(f"joint vectors have shape {q.shape}, expected (n, {len(cell.joints)})")
    return q


def group_poses(cell: Cell, q: Floats) -> PoseGroups:
    """Lay out joint vectors `q`, shape (n, n_joints) in um and rad, for the kernels."""
    q = joint_vectors(cell, q)
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


@dataclass(frozen=True, repr=False)
class Rows(Brief):
    """Rows to predict, laid out for the kernels: each is L(end) - L(start), or L(end) where start is -1."""

    poses: PoseGroups
    starts: Ints
    ends: Ints
    parts: tuple[tuple[int, Ints, "Rows"], ...] = ()  # beam's number, positions, rows, of further beams
    blocks: tuple[tuple[slice, "Rows"], ...] = ()  # of many rows, in place of the first three: positions, rows


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
    sides: tuple[int, ...] = ()  # the same of each beam in a cell with further ones

    @cached_property
    def _path(self) -> int:
        return 0 if self.cell.opd == "axis" else 2 * self.side or 1

    @cached_property
    def views(self) -> tuple[tuple["CavityModel", Ints], ...]:
        """The model as each beam sees it, with the positions of its free parameters among those of the cell."""
        made = []
        for (cell, index), side in zip(self.cell.views, self.sides or (0,) * len(self.cell.views), strict=True):
            place = {int(slot): i for i, slot in enumerate(self.free.slots)}
            seen = [(slot, place[int(i)]) for slot, i in enumerate(index) if int(i) in place]
            view = CavityModel(cell, ParameterSet(cell.parameters[slot] for slot, _ in seen), self.held[index], side)
            made.append((view, np.array([i for _, i in seen], dtype=np.int64)))
        return tuple(made)

    def facing(self, values: Floats, rows: Rows) -> "CavityModel":
        """The model whose perpendicular lengths are smooth, the mirror standing as at free parameters `values` (n,)."""
        if rows.parts:
            sides = [0] * len(self.views)
            for beam, _, part in rows.parts:
                view, own = self.views[beam]
                sides[beam] = view.facing(values[own], part).side
            return replace(self, sides=tuple(sides))
        if self.cell.opd != "perpendicular":
            return self
        if rows.blocks:
            found = {self.facing(values, block).side for _, block in rows.blocks}
            return replace(self, side=found.pop() if len(found) == 1 else 0)
        n_poses = len(rows.poses.prismatic_q)
        poses = Rows(rows.poses, np.full(n_poses, -1, dtype=np.int64), np.arange(n_poses))
        ahead = replace(self, side=1).predict(values, poses) > 0
        return replace(self, side=1 if ahead.all() else 0 if ahead.any() else -1)

    @cached_property
    def _as_told(self) -> Bools:
        """Whether each joint moves as it is told, without gain or runout, shape (n_joints,)."""
        own = STRIDE * np.arange(len(self.cell.joints))[:, None] + np.arange(GAIN, STRIDE)
        told: Bools = ~((self.held[own] != 0) | np.isin(own, self.free.slots)).any(axis=1)
        return told

    @cached_property
    def _columns(self) -> Ints:
        return self._columns_of(self.free.slots)

    def _columns_of(self, slots: Ints) -> Ints:
        return (derivative_columns if self.cell.target == "plane-mirror" else point_columns)(self.cell.revolute, slots)

    def vector(self, values: Floats) -> Floats:
        """Model vector (model size,) with the free parameters at `values` (n,); or of many of them, (n_vectors, n)."""
        vector = np.broadcast_to(self.held, (*np.shape(values)[:-1], len(self.held))).copy()
        vector[..., self.free.slots] = values
        return vector

    def rows(self, q_start: Floats, q_end: Floats, absolute: Bools | None = None, beam: Ints | None = None) -> Rows:
        """Lay out sweeps (n_rows, n_joints); `absolute` rows give L(end) itself, `beam` (the first) read each row."""
        if self.cell.further:
            beam = np.zeros(len(q_end), dtype=np.int64) if beam is None else beam
            whole = replace(self, cell=self.views[0][0].cell).rows(q_start, q_end, absolute)
            parts = []
            for number in np.unique(beam).tolist() or [0]:
                at = np.flatnonzero(beam == number)
                some = None if absolute is None else absolute[at]
                parts.append((number, at, self.views[number][0].rows(q_start[at], q_end[at], some)))
            return replace(whole, parts=tuple(parts))
        if len(q_end) > _BLOCK:
            places = [slice(i, i + _BLOCK) for i in range(0, len(q_end), _BLOCK)]
            blocks = [self.rows(q_start[at], q_end[at], None if absolute is None else absolute[at]) for at in places]
            nothing = np.broadcast_to(np.int64(-1), len(q_end))
            return Rows(blocks[0].poses, nothing, nothing, blocks=tuple(zip(places, blocks, strict=True)))
        poses = group_poses(self.cell, np.concatenate([q_start, q_end]))
        starts, ends = np.split(poses.inverse, 2)
        if absolute is not None:
            starts = np.where(absolute, -1, starts)
        return Rows(poses, np.ascontiguousarray(starts), np.ascontiguousarray(ends))

    def turned(self, rows: Rows, way: Floats) -> Rows:
        """The rows with each joint counted the other way where `way`, shape (n_joints,), is -1 in place of 1."""
        poses, along = rows.poses, way[~self.cell.revolute]
        turned = {name: getattr(poses, name) * way for name in ("group_q", "group_sin")}
        parts = tuple((beam, at, self.turned(part, way)) for beam, at, part in rows.parts)
        blocks = tuple((at, self.turned(block, way)) for at, block in rows.blocks)
        return replace(
            rows, poses=replace(poses, **turned, prismatic_q=poses.prismatic_q * along), parts=parts, blocks=blocks
        )

    def pose_rows(self, q: Floats, beam: Ints | None = None) -> Rows:
        """Lay out poses `q` (n, n_joints) whose cavity length itself is wanted; `beam` as in `rows`."""
        if self.cell.further:
            return self.rows(q, q, np.ones(len(q), dtype=bool), beam)
        poses = group_poses(self.cell, q)
        return Rows(poses, np.full(len(q), -1, dtype=np.int64), poses.inverse)

    def half_waves(self, rows: Rows) -> Floats:
        """Half the wavelength of the beam that read each row, in um, shape (n_rows,)."""
        waves = np.full(len(rows.ends), 0.5 * self.cell.wavelength)
        for beam, at, _ in rows.parts:
            waves[at] = 0.5 * self.views[beam][0].cell.wavelength
        return waves

    def predict(self, values: Floats, rows: Rows) -> Floats:
        """Predict rows for free parameters (n,) or (n_vectors, n); shape (n_rows,) or (n_vectors, n_rows), in um."""
        many = self._vectors(values)
        if rows.parts:
            result = np.empty((len(many), len(rows.ends)))
            for beam, at, part in rows.parts:
                view, own = self.views[beam]
                result[:, at] = view.predict(many[:, own], part)
        elif rows.blocks:
            result = np.empty((len(many), len(rows.ends)))
            for place, block in rows.blocks:
                result[:, place] = self.predict(many, block)
        elif self.cell.target == "plane-mirror":
            # Vectors fill the lanes of the kernel; where these are few, many groups of poses do.
            turns_as_told = bool(self._as_told[self.cell.revolute].all())
            groups_fill = len(many) < LANES // 4 and len(rows.poses.group_q) > LANES and turns_as_told
            result = (few_vector_lengths if groups_fill else batch_lengths)(self._question(many, rows))
        else:
            result, _ = self._differentiated(many, rows, self._columns[:0])
        return result[0] if np.ndim(values) == 1 else result

    def predict_with_jacobian(self, values: Floats, rows: Rows) -> tuple[Floats, Floats]:
        """As `predict`, with derivatives by the free parameters, shape (n_rows, n) or (n_vectors, n_rows, n)."""
        many = self._vectors(values)
        if rows.parts:
            result = np.empty((len(many), len(rows.ends)))
            jacobian = np.zeros((*result.shape, len(self.free)))
            for beam, at, part in rows.parts:
                view, own = self.views[beam]
                result[:, at], jacobian[:, at[:, None], own] = view.predict_with_jacobian(many[:, own], part)
        elif rows.blocks:
            result = np.empty((len(many), len(rows.ends)))
            jacobian = np.empty((*result.shape, len(self.free)))
            for place, block in rows.blocks:
                result[:, place], jacobian[:, place] = self.predict_with_jacobian(many, block)
        else:
            result, jacobian = self._differentiated(many, rows, self._columns)
        return (result[0], jacobian[0]) if np.ndim(values) == 1 else (result, jacobian)

    def _vectors(self, values: Floats) -> Floats:
        """Parameter vectors (n_vectors, n) as the kernels read them, which look at no shape."""
        many = np.ascontiguousarray(np.atleast_2d(values), dtype=float)
        if many.ndim != 2 or many.shape[1] != len(self.free):
            n = len(self.free)
            raise ValueError(f"parameter vectors have shape {np.shape(values)}, expected ({n},) or (n_vectors, {n})")
        return many

    def _differentiated(self, values: Floats, rows: Rows, columns: Ints) -> tuple[Floats, Floats]:
        kernel = batch_jacobians if self.cell.target == "plane-mirror" else batch_points
        return kernel(self._question(values, rows), columns)

    def joint_jacobian(self, values: Floats, q: Floats, beam: Ints | None = None) -> Floats:
        """Derivatives of the length by the joints at poses (n_poses, n_joints), by the number of each pose's beam."""
        if self.cell.further:
            moves = np.empty(q.shape)
            for number, (view, own) in enumerate(self.views):
                at = np.full(len(q), number == 0) if beam is None else beam == number
                moves[at] = view.joint_jacobian(values[own], q[at])
            return moves
        n_joints = len(self.cell.joints)
        links = np.arange(n_joints) * STRIDE
        wanted = np.concatenate([links + np.where(self.cell.revolute, THETA, R), links + R]).astype(np.int64)
        _, columns = self._differentiated(self._vectors(values), self.pose_rows(q), self._columns_of(wanted))
        moved, along = columns[0][:, :n_joints], columns[0][:, n_joints:]
        link_values = self.vector(values)[: STRIDE * n_joints].reshape(n_joints, STRIDE)
        gain, runout_cos, runout_sin = link_values[:, RUNOUT_COS - 1 :].T
        turned = q * (1.0 + gain)
        climb = np.where(self.cell.revolute, runout_sin * np.cos(turned) - runout_cos * np.sin(turned), 0.0)
        return np.asarray((moved + climb * along) * (1.0 + gain))

    def joint_pulls(self, values: Floats, q: Floats, pulls: Floats, beam: int, steps: Floats) -> Floats:
        """Derivatives by the joints of the derivative of a beam's length along directions `pulls` of the parameters.

        `values` (n_vectors, n), `q` (n_poses, n_joints) and `pulls` (n_vectors, n_poses, n); summed over the vectors,
        shape (n_poses, n_joints). Where turns are not as told, or the target is a point, by differences of `steps`.
        """
        if self.cell.further:
            view, own = self.views[beam]
            return view.joint_pulls(values[:, own], q, np.ascontiguousarray(pulls[..., own]), 0, steps)
        if self.cell.target == "plane-mirror" and self._as_told.all():
            return joint_pulls(self._question(self._vectors(values), self.pose_rows(q)), self._columns, pulls)
        further = q[:, None] + np.vstack([np.zeros(len(steps)), np.diag(steps)])
        _, jacobian = self.predict_with_jacobian(values, self.pose_rows(further.reshape(-1, len(steps))))
        seen = (jacobian.reshape(*pulls.shape[:2], -1, pulls.shape[2]) @ pulls[..., None]).sum(axis=0)[..., 0]
        return np.asarray((seen[:, 1:] - seen[:, :1]) / steps)

    def mirrors(self, values: Floats, q: Floats) -> tuple[Floats, Floats]:
        """Normals and origins of the first beam's mirror, ([n_vectors,] n_poses, 3); `InputError` for a point."""
        if self.cell.target != "plane-mirror":
            raise InputError(f"cell {self.cell.name!r}: a {self.cell.target} has no normal, expected a plane mirror")
        many = self._vectors(values)
        joints = joint_vectors(self.cell, q)
        if self.cell.further:
            view, own = self.views[0]
            return view.mirrors(values[..., own], q)
        normals, origins = batch_mirrors(self.held, self.free.slots, many, self.cell.revolute, joints)
        return (normals[0], origins[0]) if np.ndim(values) == 1 else (normals, origins)

    def _question(self, values: Floats, rows: Rows) -> Question:
        cell, poses = self.cell, rows.poses
        groups = poses.group_q, poses.group_cos, poses.group_sin, poses.group_start, poses.prismatic_q
        asked = self.held, self.free.slots, values, self._path, cell.optical_axis == "z", cell.revolute
        return *asked, groups, rows.starts, rows.ends
