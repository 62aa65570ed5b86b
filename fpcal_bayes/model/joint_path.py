"""Every pose that a robot may take on its way through sweeps or a task, also between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.axes import home
from fpcal_bayes.model.cell.cell import Cell

#: Poses of a sweep that are looked at, both ends included.
POINTS = 9
#: Speeds of joints that state none, in um and rad a second.
TRAVEL_SPEED, TURN_SPEED = 100.0, float(np.radians(2.0))
#: Turns of more than this are looked at between their ends, in rad.
_TURN_STEP = float(np.radians(30.0))


@dataclass(frozen=True)
class JointPath:
    """Poses in the order of the rows they belong to."""

    q: Floats  # shape (n_poses, n_joints), in um and rad
    row: Ints  # position of the row that each pose belongs to, shape (n_poses,)
    between: Bools  # whether a pose lies on the way to its row's start, shape (n_poses,)
    step: Ints  # pairs of poses between which the joints move straight, by position, shape (n_steps, 2)
    seconds: Floats  # that each step takes, shape (n_steps,)


def speeds(cell: Cell) -> Floats:
    """What each joint travels or turns in a second, shape (n_joints,)."""
    stated = [np.nan if joint.speed is None else joint.speed for joint in cell.joints]
    return np.where(np.isnan(stated), np.where(cell.revolute, TURN_SPEED, TRAVEL_SPEED), stated)


def in_turn(cell: Cell, moved: Bools) -> bool:
    """Whether joints that move, shape (n_joints,), must move one after the other: no group allows them at once."""
    joints = set(np.flatnonzero(moved).tolist())
    groups = () if cell.envelope is None else cell.envelope.together
    return len(joints) > 1 and not any(joints <= set(group) for group in groups)


def travel_seconds(cell: Cell, moves: Floats) -> Floats:
    """Time that moves (..., n_joints) take, shape (...): joints that may move at once do, the others take turns."""
    times = np.abs(moves) / speeds(cell)
    if cell.envelope is None:
        return np.asarray(times.max(axis=-1))
    left, seconds = set(range(len(cell.joints))), np.zeros(times.shape[:-1])
    for group in sorted(cell.envelope.together, key=len, reverse=True):
        if left & set(group):
            seconds = seconds + times[..., sorted(left & set(group))].max(axis=-1)
            left -= set(group)
    return np.asarray(seconds + times[..., sorted(left)].sum(axis=-1))


def sweep_path(cell: Cell, q_start: Floats, q_end: Floats, *, ways: bool = True) -> JointPath:
    """The path of sweeps (n_rows, n_joints) driven in order; `ways`: also from zero to the first and between them."""
    pieces, steps, count = [], [], 0
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    before = home(cell)
    for start, end in zip(q_start, q_end, strict=True):
        way = box(cell, before, start) if ways else start[None][:0]
        line = start + share * (end - start)
        if in_turn(cell, start != end):
            line = np.vstack([line, box(cell, start, end)])
        first = count + len(way)
        steps.append(np.column_stack([np.arange(first, first + POINTS - 1), np.arange(first + 1, first + POINTS)]))
        pieces.append((way, line))
        count += len(way) + len(line)
        before = end
    return _joined(cell, pieces, steps)


def task_path(cell: Cell, q: Floats, start: Floats | None = None) -> JointPath:
    """The path of a task through joint vectors (n_points, n_joints), from `start`, by default joint zero."""
    pieces, steps, count = [], [], 0
    before = home(cell) if start is None else start
    for row, point in enumerate(q):
        way = box(cell, before, point) if row == 0 or in_turn(cell, before != point) else point[None][:0]
        if row > 0:
            steps.append(np.array([[count - 1, count + len(way)]]))
        pieces.append((way, point[None]))
        count += len(way) + 1
        before = point
    return _joined(cell, pieces, steps)


def _joined(cell: Cell, pieces: Sequence[tuple[Floats, Floats]], steps: Sequence[Ints]) -> JointPath:
    """A path from the way to each row's start and the poses of the row itself."""
    q = np.vstack([part for piece in pieces for part in piece])
    row = np.repeat(np.arange(len(pieces)), [len(way) + len(line) for way, line in pieces])
    between = np.concatenate([np.repeat([True, False], [len(way), len(line)]) for way, line in pieces])
    step = np.vstack(steps) if steps else np.zeros((0, 2), dtype=np.int64)
    seconds = (np.abs(q[step[:, 1]] - q[step[:, 0]]) / speeds(cell)).max(axis=1, initial=0.0)
    return JointPath(q, row, between, step, seconds)


def box(cell: Cell, start: Floats, end: Floats) -> Floats:
    """Poses between two, whatever the order in which the joints move: corners, and middles of those that turn."""
    # The distance of the mirror's plane is linear in each joint that travels: its extremes are at the ends.
    values = [
        (start[i],) if start[i] == end[i] else (start[i], end[i], (start[i] + end[i]) / 2.0)[: 3 if turns else 2]
        for i, turns in enumerate(cell.revolute)
    ]
    return np.array(list(product(*values)))


def lattice(cell: Cell, low: Floats, high: Floats) -> tuple[Floats, tuple[int, ...]]:
    """Poses of a box of joints, and how many values each joint has there: its ends, and values between if it turns."""
    ends = zip(low.tolist(), high.tolist(), cell.revolute, strict=True)
    values = [np.unique(np.linspace(a, b, 3 + 2 * int((b - a) / _TURN_STEP) if turns else 2)) for a, b, turns in ends]
    return np.array(list(product(*values))), tuple(map(len, values))
