"""Tasks: the paths that a calibrated robot is judged on, and a user's own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, UnreachableError
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.io.joint_paths import read_path
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import home, joint_axes
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import OWN_KINDS, OwnTask
from fpcal_bayes.model.inverse import InverseModel
from fpcal_bayes.model.inverse_few import LEVER
from fpcal_bayes.motion.placement import Placement

TASKS: tuple[str, ...] = ("circle", "line-x", "line-z", "tilt-x", "tilt-z", "spin")

#: Half the length of the lines in um, half the tilt and the farthest spin in rad.
HALF_LINE = 150.0
HALF_TILT = float(np.radians(3.0))
FARTHEST_SPIN = float(np.radians(90.0))
#: Steps in which a spin looks for the first joint limit, and how closely it is found, in rad.
_SPIN_STEP, _SPIN_GOAL = float(np.radians(1.0)), 1e-9
#: A spin of less than this is none, in rad.
_SPIN_LEAST = 1e-3
#: Status of a point that asks for a direction that no axis has; the share of a move, and um, that may be left undone.
NO_AXIS = "out of reach: no axis moves or turns in this direction"
_LEFT_UNDONE, _UNSEEN = 0.1, 0.01


@dataclass(frozen=True)
class Task:
    """A commanded path, and the joint path that a model vector makes of it."""

    name: str  # one of `TASKS`, or the name of a path file
    cell: Cell  # whose joints follow the path
    #: Commanded moves away from the aligned pose, shape (n_points, 6), in um and rad (see `Placement.moved`).
    offsets: Floats
    #: Commanded poses fX of the mirror frame at the reflection point, in the fibre frame, shape (n_points, 4, 4).
    poses: Floats
    #: Joint path, shape (n_points, n_joints), in um and rad; NaN where a pose is out of reach, beyond a limit where it
    #: is saturated: drive to points whose status is ``ok`` only.
    q: Floats
    status: NDArray[np.str_]  # of each point: ``ok`` or the reason why it cannot be driven to, shape (n_points,)
    #: Joint vector of the aligned pose, from which the changes of cavity length are counted, shape (n_joints,).
    start: Floats
    along: Floats  # where each point stands on the path, shape (n_points,), in `unit`
    unit: str  # ``um`` or ``deg``, or ``point`` for a user's path
    #: Where the joint path makes up for error motions: what that adds to the change of cavity length that the geometry
    #: expects, in um, shape (n_points,), and the joint path without it, shape (n_points, n_joints).
    added: Floats | None = None
    plain: Floats | None = None

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        return f"Task({self.name}, {self.ok.sum()} of {len(self)} points can be driven to)"

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Whether each point can be driven to, shape (n_points,)."""
        return np.asarray(self.status == "ok")

    @property
    def finite(self) -> NDArray[np.bool_]:
        """Whether the model gives joint values for each point, inside the limits or not, shape (n_points,)."""
        return np.isfinite(self.q).all(axis=1)

    def driven(self) -> "Task":
        """The same task at the points that can be driven to."""
        if not self.ok.any():
            raise InputError(f"task {self.name!r}: no point can be driven to; point 1: {self.status[0]}")
        return self.take(self.ok)

    def within_turns(self) -> "Task":
        """As `driven`; where joints that turn alone keep every point away, as far as these turn."""
        low, high = (
            np.where(self.cell.revolute, a, b) for a, b in ((self.cell.low, -np.inf), (self.cell.high, np.inf))
        )
        q, start = np.clip(self.q, low, high), np.clip(self.start, low, high)
        if self.ok.any() or not self.finite.all() or (q < self.cell.low).any() or (q > self.cell.high).any():
            return self.driven()
        return replace(self, q=q, start=start, status=np.full(len(self), "ok"))

    def take(self, chosen: Bools | Ints) -> "Task":
        """The same task at some of its points, a mask (n_points,) or positions."""
        return replace(
            self,
            offsets=self.offsets[chosen],
            poses=self.poses[chosen],
            q=self.q[chosen],
            status=self.status[chosen],
            along=self.along[chosen],
            added=None if self.added is None else self.added[chosen],
            plain=None if self.plain is None else self.plain[chosen],
        )


def task_path(
    cell: Cell, vector: Floats, name: str, radius: float | None = None, n_points: int = 61, at: Placement | None = None
) -> Task:
    """A task of `TASKS`, or of the cell's own, as a joint path by a model vector (model size,).

    All tasks start from the aligned pose, q0: mirror normal Zt along +Yf, Xt along Xf, and the mirror point that
    reflects at joint vector zero, tPr, where it reflects there, wPr. ``circle`` translates around wPr in the mirror
    plane, ``line-x`` and ``line-z`` along Xf and Zf from -150 to 150 um; ``tilt-x`` and ``tilt-z`` turn by -3 to 3 deg
    about Xf and Zf through wPr, less where the limits are narrower (see `half_line`, `half_tilt`); ``spin`` turns about
    Yf through wPr, to either side until a joint limit or 90 deg. By default the radius is `default_radius`; the
    task is placed `at` the vector's own placement.
    """
    own = {task.name: task for task in cell.tasks}
    if name not in TASKS and name not in own:
        known = ", ".join([*TASKS, *own])
        raise InputError(f"unknown task {name!r}: expected one of {known}, or the name of a path CSV")
    radius = default_radius(cell) if radius is None else radius
    if not (np.isfinite(radius) and radius > 0):
        raise InputError(f"radius {radius:g} um: expected a number above zero")
    if n_points < 2:
        raise InputError(f"task {name!r} with {n_points} points: expected at least two")
    placement, offsets = at or Placement.of(cell, vector), np.zeros((n_points, 6))
    task = own[name] if name in own else _built_in(cell, vector, placement, name, radius)
    offsets[:, :3] = task.centre
    if task.kind == "circle":
        phase = np.linspace(0.0, 2.0 * np.pi, n_points)
        offsets[:, [0, 2]] += task.radius * np.column_stack([np.cos(phase), np.sin(phase)])
        along = np.degrees(phase)
    else:
        along = np.linspace(task.low, task.high, n_points)
        offsets[:, OWN_KINDS[task.kind]] += along
        along = np.degrees(along) if task.turns else along
    unit = "deg" if task.turns or task.kind == "circle" else "um"
    return _follow(cell, vector, placement, name, offsets, along, unit)


def _built_in(cell: Cell, vector: Floats, placement: Placement, name: str, radius: float) -> OwnTask:
    if name == "circle":
        return OwnTask(name, name, radius)
    if name == "spin":
        low, high = (_spin_end(cell, vector, placement, side) for side in (-1.0, 1.0))
        # A robot that cannot spin says so at every point.
        if len(cell.joints) < 6 and high - low < _SPIN_LEAST:
            low, high = -FARTHEST_SPIN, FARTHEST_SPIN
        return OwnTask(name, name, low=low, high=high)
    half = half_line(cell) if name.startswith("line") else half_tilt(cell)
    return OwnTask(name, name, low=-half, high=half)


def half_line(cell: Cell) -> float:
    """Half the length of the lines in um: 150, or nine tenths of the shortest travel to a side where that is less."""
    vector = cell.parameters.nominal
    directions, _ = joint_axes(cell, vector, home(cell))
    across = np.abs(directions @ chain.optical_axis(cell, vector)) < 0.5
    moving = [joint for joint, beside in zip(cell.joints, across, strict=True) if beside and joint.kind == "prismatic"]
    shortest = min([min(joint.high, -joint.low) for joint in moving], default=HALF_LINE)
    return HALF_LINE if shortest >= HALF_LINE or shortest <= 0 else 0.9 * shortest


def half_tilt(cell: Cell) -> float:
    """Half the tilt in rad: 3 deg, or six tenths of the smallest turn to a side where that is less."""
    sides = [min(joint.high, -joint.low) for joint in cell.joints if joint.kind == "revolute"]
    smallest = 0.6 * min(sides, default=np.inf)
    # Six tenths of 5 deg are 3 deg but for the last digit.
    return float(smallest) if 0 < smallest < (1.0 - 1e-9) * HALF_TILT else HALF_TILT


def default_radius(cell: Cell) -> float:
    """Radius of the circle in um where none is given: two thirds of half a line, 100 on a stage of 300 um."""
    return half_line(cell) / 1.5


def possible_tasks(cell: Cell, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """Those of some built-in tasks, by default all and the cell's own, that the nominal cell has the axes for."""
    names = (*TASKS, *(task.name for task in cell.tasks)) if names is None else names
    if len(cell.joints) == 6:
        return tuple(names)
    vector = cell.parameters.nominal
    few = {name: task_path(cell, vector, name, n_points=8).status for name in names if name in TASKS}
    return tuple(name for name in names if not any(text.startswith("out of reach") for text in few.get(name, ())))


def user_path(cell: Cell, vector: Floats, path: str | Path) -> Task:
    """A user's path as a task: moves in the fibre frame, relative to the aligned pose (see `Placement.moved`)."""
    offsets = read_path(path)
    placement = Placement.of(cell, vector)
    return _follow(cell, vector, placement, Path(path).name, offsets, np.arange(1.0, len(offsets) + 1.0), "point")


def find_task(
    cell: Cell, vector: Floats, task: str, radius: float | None = None, n_points: int = 61, at: Placement | None = None
) -> Task:
    """A task by name, or a user's path by file name; as `task_path` and `user_path`.

    Raises
    ------
    InputError
        If no task has the name, or `vector` is not of the cell's model.
    """
    if vector.shape != (len(cell.parameters),) or not np.isfinite(vector).all():
        raise InputError(f"vector of shape {vector.shape}: expected {len(cell.parameters)} finite numbers")
    if task in TASKS or not task.lower().endswith(".csv"):
        return task_path(cell, vector, task, radius=radius, n_points=n_points, at=at)
    return user_path(cell, vector, task)


def follow_offsets(cell: Cell, vector: Floats, name: str, offsets: Floats, near: Floats | None = None) -> Task:
    """Moves `offsets` (n_points, 6), in um and rad, as a task (see `Placement.moved`), looked for near `near`."""
    along = np.arange(1.0, len(offsets) + 1.0)
    return _follow(cell, vector, Placement.of(cell, vector), name, offsets, along, "point", near)


def _follow(
    cell: Cell,
    vector: Floats,
    placement: Placement,
    name: str,
    offsets: Floats,
    along: Floats,
    unit: str,
    near: Floats | None = None,
) -> Task:
    inverse, zero = InverseModel(cell), np.zeros(len(cell.joints))
    first = inverse.solve(vector, placement.tool_poses(placement.aligned), near=zero)
    poses = placement.moved(offsets)
    tools = placement.tool_poses(poses)
    found = inverse.solve(vector, tools, near=zero if near is None else near, follow=True)
    texts = found.texts()
    if len(cell.joints) < 6 and np.isfinite(first.q).all():
        texts = np.where(_beyond_directions(inverse, vector, placement, tools, found.q, first.q), NO_AXIS, texts)
    return Task(name, cell, offsets, poses, found.q, texts, first.q, along, unit)


def _beyond_directions(
    inverse: InverseModel, vector: Floats, placement: Placement, tools: Floats, q: Floats, start: Floats
) -> NDArray[np.bool_]:
    """Whether a robot of fewer than six joints leaves undone what each point asks for beside the start, (n_points,)."""
    first = placement.tool_poses(placement.aligned)[None]
    missed = inverse.missed(vector, tools, q) - inverse.missed(vector, first, start[None])
    asked = np.linalg.norm(tools[:, :3, 3] - first[0, :3, 3], axis=1)
    turned = np.linalg.norm(tools[:, :3, :3] - first[0, :3, :3], axis=(1, 2)) / np.sqrt(2.0) * LEVER
    beyond: NDArray[np.bool_] = np.linalg.norm(missed, axis=1) > _LEFT_UNDONE * np.hypot(asked, turned) + _UNSEEN
    return beyond


def _spin_end(cell: Cell, vector: Floats, placement: Placement, side: float) -> float:
    """The farthest angle about Yf, in rad, up to which every pose on the way can be reached."""
    inverse = InverseModel(cell)

    def reached(angles: Floats) -> NDArray[np.bool_]:
        offsets = np.zeros((len(angles), 6))
        offsets[:, 4] = side * angles
        tools = placement.tool_poses(placement.moved(offsets))
        found = inverse.solve(vector, tools, near=np.zeros(len(cell.joints)), follow=True)
        # A joint a rounding error beyond its limit is ok elsewhere; a path that seeks the limit ends inside it.
        good: NDArray[np.bool_] = found.ok & ((found.q >= cell.low) & (found.q <= cell.high)).all(axis=1)
        if len(cell.joints) < 6:
            good &= ~_beyond_directions(inverse, vector, placement, tools, found.q, found.q[np.argmin(angles)])
        if angles[0] == 0.0 and not good[0]:
            if not found.ok[0]:
                raise UnreachableError(f"the aligned pose cannot be reached with this estimate: {found.texts()[0]}")
            good[0] = True
        return good

    steps = np.linspace(0.0, FARTHEST_SPIN, round(FARTHEST_SPIN / _SPIN_STEP) + 1)
    good = reached(steps)
    if good.all():
        return side * FARTHEST_SPIN
    first_bad = int(np.argmin(good))
    inside, outside = float(steps[first_bad - 1]), float(steps[first_bad])
    while outside - inside > _SPIN_GOAL:
        between = np.linspace(inside, outside, 18)[1:-1]
        good = reached(between)
        place = len(good) if good.all() else int(np.argmin(good))
        inside, outside = (
            float(between[place - 1]) if place > 0 else inside,
            float(between[place]) if place < len(good) else outside,
        )
    return side * inside
