"""Plans and joint paths in the words of the controllers, and what these logged as sweeps again.

A file of moves has one row per axis and pose: rows of one `move` lead to one pose, in their order, or in step where
`in_step` is 1. `position` is what the axis shows, in its own `unit`, sign and zero. `reading` says where the length is
read: 0 at the start of a sweep, 1 and on along it, nothing on a path. A log may lack everything but the first six
columns; then moves 1 and 2, 3 and 4 and so on are start and end of sweeps. `length_um`, the cavity length or counter
that was read at a pose, and `sigma_um`, of the difference of two, make a plan a measurement.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.times import clock
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import read_records, write_table
from fpcal_bayes.io.recordings_mat import load_variables, mat_numbers, mat_texts, write_mat
from fpcal_bayes.measure.protocol import seen_by_all
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Order
from fpcal_bayes.model.cell.cell import Cell, check_joints

_TEXTS = ("controller", "channel", "unit", "utc", "session", "label", "group")
_NUMBERS = ("move", "position", "reading", "time_h", "in_step", "speed", "dwell_s", "length_um", "sigma_um")
_NEEDED = ("move", "controller", "channel", "unit", "position")
_WRITTEN = (*_NEEDED, "utc", *_NUMBERS[2:7], *_TEXTS[4:])
#: Seconds that an axis stands still before the length is read.
_DWELL_S = 1.0


@dataclass(frozen=True)
class _Pose:
    """Where the axes are to stand, q (n_joints,) in um and rad, and which joints move there in step."""

    q: Floats
    in_step: frozenset[int] = frozenset()
    session: str = ""
    time_h: float = np.nan
    label: str = ""
    group: str = ""
    reading: float = np.nan


def write_order_moves(path: str | Path, orders: Sequence[Order], cell: Cell) -> None:
    """Write the drives of a plan as moves, CSV or MATLAB; `InputError` if the cell's controllers cannot make them."""
    poses = []
    for order in orders:
        moving = frozenset(np.flatnonzero((order.targets != order.start).any(axis=0)).tolist())
        names = {cell.joints[j].controller.name for j in moving if cell.joints[j].controller is not None}  # type: ignore[union-attr]
        if len(names) > 1:
            joints = ", ".join(f"q{j + 1}" for j in sorted(moving))
            raise InputError(f"{path}: sweep {order.label!r} moves {joints} in step, expected joints of one controller")
        at = _Pose(order.start, frozenset(), order.session, order.time_h, order.label, order.group, 0.0)
        step = moving if len(moving) > 1 else frozenset()
        poses.append(at)
        poses += [
            replace(at, q=q, in_step=step, label=label, reading=float(number))
            for number, (q, label) in enumerate(zip(order.targets, order.labels, strict=True), 1)
        ]
    _write(Path(path), poses, cell)


def write_path_moves(path: str | Path, q: Floats, cell: Cell) -> None:
    """Write a joint path (n, n_joints) in um and rad as moves."""
    _write(Path(path), [_Pose(each) for each in q], cell)


def _write(path: Path, poses: Sequence[_Pose], cell: Cell) -> None:
    require_suffix(path, ".csv", ".mat")
    axes = _axes(cell)
    check_joints(cell, np.array([pose.q for pose in poses]), path, range(1, len(poses) + 1), cell.joint_columns)
    rows: list[tuple[Any, ...]] = []
    for number, pose in enumerate(poses, 1):
        for (controller, channel), j in axes.items():
            joint = cell.joints[j]
            assert joint.controller is not None
            shown = float(joint.to_controller(pose.q[j] / cell.joint_scales[j]))
            speed = np.nan if joint.speed is None else joint.speed / joint.controller.per_unit
            row = (number, controller, channel, joint.controller.unit, shown, "", pose.reading, pose.time_h)
            dwell = np.nan if np.isnan(pose.reading) else _DWELL_S
            rows.append((*row, int(j in pose.in_step), speed, dwell, pose.session, pose.label, pose.group))
    columns = {
        name: values
        for name, values in zip(_WRITTEN, zip(*rows, strict=True), strict=True)
        if name in _WRITTEN[:6] or any(value not in ("", 0) and value == value for value in values)
    }
    if path.suffix.lower() == ".csv":
        # Numbers at full length: what is read back is the joint value that was meant.
        texts = {
            name: [repr(x) if x == x else "" for x in values] if isinstance(values[0], float) else values
            for name, values in columns.items()
        }
        write_table(path, {name: np.array(values) for name, values in texts.items()})
        return
    write_mat(path, columns)


def _axes(cell: Cell) -> dict[tuple[str, str], int]:
    axes: dict[tuple[str, str], int] = {}
    for j, joint in enumerate(cell.joints):
        if joint.controller is None:
            raise InputError(f"cell {cell.name!r}: q{j + 1} names no controller, expected that key in its table")
        key = (joint.controller.name, joint.controller.channel)
        if key in axes:
            both = f"q{axes[key] + 1} and q{j + 1}"
            raise InputError(f"cell {cell.name!r}: {both} share {key[0]} {key[1]}, expected a channel each")
        axes[key] = j
    return axes


def read_moves(path: str | Path, cell: Cell, *, session: str = "session-1", time_h: float = 0.0) -> Sweeps:
    """Sweeps of a log, a plan where it holds no lengths; `session`, and `time_h` of its first row, if it is silent."""
    path = Path(path)
    table, rows = _read(path)
    joints, n = _joints_of(path, table, rows, cell), len(rows)
    values = np.empty(n)
    for i, (j, unit) in enumerate(zip(joints, table["unit"], strict=True)):
        axis = cell.joints[j].controller
        assert axis is not None
        if unit != axis.unit:
            raise located(path, f"expected {axis.unit}, as the cell has it, found {unit!r}", row=rows[i], column="unit")
        values[i] = float(cell.joints[j].from_controller(table["position"][i])) * cell.joint_scales[j]
    moves = table["move"]
    if (np.diff(moves) < 0).any():
        raise located(path, "expected moves in ascending order", row=rows[int(np.argmax(np.diff(moves) < 0)) + 1])
    ends = np.append(np.flatnonzero(np.diff(moves) > 0), n - 1)
    last, q, poses = set(ends.tolist()), np.full(len(cell.joints), np.nan), []
    found: list[set[int]] = [set()]  # joints of each move
    for i, j in enumerate(joints):
        if j in found[-1]:
            raise located(path, f"q{j + 1} stands twice in this move, expected once", row=rows[i], column="channel")
        q[j] = values[i]
        found[-1].add(j)
        if i in last:
            poses.append(q.copy())
            found.append(set())
    placed, short = np.array(poses), [len(joints) < len(cell.joints) for joints in found[:-1]]
    if np.isnan(placed[0]).any():
        what = f"q{int(np.argmax(np.isnan(placed[0]))) + 1} is not placed by the first move, expected all axes there"
        raise located(path, what, row=rows[int(ends[0])])
    if len(short) > 3 and sum(short) == 1:
        # A log may hold those axes alone that move, but then most of its moves are short.
        at = short.index(True)
        what = f"this move places {len(found[at])} axes and all others {len(cell.joints)}: the log may be cut short"
        raise located(path, what, row=rows[int(ends[at])])
    check_joints(cell, placed, path, [rows[i] for i in ends], cell.joint_columns)
    at_ends = {name: [column[i] for i in ends] for name, column in table.items()}
    return _sweeps(path, cell, placed, at_ends, session, time_h)


def _read(path: Path) -> tuple[dict[str, Any], list[int]]:
    require_suffix(path, ".csv", ".mat")
    table: dict[str, Any] = {}
    if path.suffix.lower() == ".mat":
        found, header_row = load_variables(path), None
        n = np.size(found.get("move", ()))
        rows = list(range(1, n + 1))
        for name in set(found) & {*_TEXTS, *_NUMBERS}:
            table[name] = (mat_texts if name in _TEXTS else mat_numbers)(path, name, found[name], n).tolist()
    else:
        records = read_records(path, "a header and moves")
        rows, header_row = records.rows.tolist(), records.header_row
        for name, texts in records.columns().items():
            if name in _TEXTS:
                table[name] = list(texts)
            elif name in _NUMBERS:
                stated = [text if text or name in _NEEDED else "0" for text in texts]
                numbers = records.numbers(name, stated, finite=True)
                table[name] = np.where([text != "" for text in texts], numbers, np.nan).tolist()
    for name in _NEEDED:
        if name not in table:
            raise located(path, f"the column {name} is missing", row=header_row)
    if not rows:
        raise InputError(f"{path}: no rows, expected at least two moves")
    return table, rows


def _joints_of(path: Path, table: Mapping[str, Any], rows: Sequence[int], cell: Cell) -> list[int]:
    axes, joints = _axes(cell), []
    for controller, channel, row in zip(table["controller"], table["channel"], rows, strict=True):
        if (controller, channel) not in axes:
            known = ", ".join(" ".join(key) for key in axes)
            raise located(path, f"{controller} {channel}: expected one of {known}", row=row, column="channel")
        joints.append(axes[controller, channel])
    return joints


def _sweeps(path: Path, cell: Cell, poses: Floats, of: Mapping[str, Any], session: str, time_h: float) -> Sweeps:
    """Sweeps of poses (n, n_joints); `of` holds the columns of the last row of each."""
    n, numbers = len(poses), range(len(poses))
    reading = np.array(of["reading"]) if "reading" in of else np.array([float(i % 2) for i in numbers])
    starts = np.flatnonzero(reading == 0)
    if not len(starts) or starts[0] != 0 or np.isnan(reading).any() or (np.diff(np.append(starts, n)) < 2).any():
        what = "expected moves to the start of a sweep, then along it: an even number without readings"
        raise InputError(f"{path}: {what}")
    start_of = starts[np.searchsorted(starts, np.arange(n), side="right") - 1]
    rows = np.flatnonzero(reading > 0)
    several = np.bincount(start_of, minlength=n)[start_of] > 2
    utc = [str(text) for text in of.get("utc", [""] * n)]
    hours = np.array(of.get("time_h", [np.nan] * n), dtype=float)
    try:
        clocks = [clock(text).timestamp() / 3600.0 if text else np.nan for text in utc]
    except ValueError as error:
        raise InputError(f"{path}: column utc: expected ISO 8601 as in 2024-05-01T08:30:00Z") from error
    since = np.array(clocks) - clocks[0]
    hours = np.where(np.isnan(hours), time_h + np.where(np.isnan(since), 0.0, since), hours)
    labels = [str(text) or f"row {i}" for i, text in enumerate(of.get("label", [""] * n), 1)]
    groups = [str(of["group"][i]) if "group" in of else f"sweep {start_of[i]}" * bool(several[i]) for i in numbers]
    lengths, sigma = (np.array(of.get(name, [np.nan] * n), dtype=float) for name in ("length_um", "sigma_um"))
    dl = lengths - lengths[start_of]
    if "length_um" in of and np.isnan(np.concatenate([dl[rows], sigma[rows]])).any():
        raise InputError(f"{path}: expected length_um at every reading, and sigma_um of each change")
    sweeps = Sweeps.of_um_rad(
        poses[start_of[rows]],
        poses[rows],
        session=[str(of["session"][i]) if "session" in of else session for i in rows],
        label=[labels[i] for i in rows],
        time_h=hours[rows],
        dl=dl[rows],
        sigma=sigma[rows],
        group=[groups[i] for i in rows],
        utc=[utc[i] for i in rows],
        file=str(path),
        rows=rows + 1,
    )
    sweeps = sweeps if sweeps.measured else seen_by_all(sweeps, cell)
    check_sweeps(sweeps, cell)
    return sweeps
