"""The columns of a sweep file: their names, and sweeps as columns in um and deg and back."""

import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.measure.sweeps import MAX_TEXT, Sweeps, check_sweeps
from fpcal_bayes.model.cell.cell import Cell

Column = NDArray[Any]

LEADING = ("session", "time_h", "label")
MEASUREMENT = ("dl_um", "sigma_um", "signed")
OPTIONAL = ("group", "kind", "trace", "utc", "temperature_c")
TEXTS = ("session", "label", "group", "kind", "trace", "utc")

_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_JOINT = re.compile(r"q\d+_(start|end)_(um|deg)")
# Python also reads dates alone and any letter between date and time; a file says both, the usual way.
_UTC = re.compile(r"\d{4}-?\d\d-?\d\d[T ]\d\d(:?\d\d){0,2}([.,]\d+)?(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII)


def joint_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the joint columns of a sweep, start pose before end pose: ``q1_start_um`` .. ``q6_end_deg``."""
    split = [name.split("_") for name in cell.joint_columns]
    return tuple(f"{joint}_{end}_{unit}" for end in ("start", "end") for joint, unit in split)


def required_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the columns that every file of measured sweeps has, in their order."""
    return (*LEADING, *joint_columns(cell), *MEASUREMENT)


def shown(value: object) -> str:
    """A value as it stands in a message: quoted and no longer than a line."""
    text = str(value)
    return repr(text if len(text) <= 40 else text[:40] + "...")


def check_names(names: Sequence[str], cell: Cell, file: object, *, plan: bool, row: int | None = None) -> None:
    """Hold the names of a file's columns to those of the cell.

    Parameters
    ----------
    names
        As found in the file.
    file, row
        For the message.
    plan
        Whether the columns of a measurement, session, time and label may be missing.

    Raises
    ------
    InputError
        If a column repeats, is unknown, is missing, or belongs to a cell with other joints.
    """
    required, joints = required_columns(cell), joint_columns(cell)
    owns = f"cell {cell.name!r} has {len(cell.joints)} joints, {', '.join(cell.joint_columns)}"
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise located(file, f"the column {shown(name)} stands twice", row=row)
        seen.add(name)
        if name in required or name in OPTIONAL:
            continue
        if _JOINT.fullmatch(name):
            raise located(file, f"column {name} does not fit: {owns}", row=row)
        expected = f"expected {','.join(required)}, then any of {','.join(OPTIONAL)}"
        raise located(file, f"unknown column {shown(name)}, {expected}", row=row)
    for name in joints if plan else required:
        if name not in seen:
            hint = f": {owns}" if name in joints else ""
            raise located(file, f"the column {name} is missing{hint}", row=row)


def to_columns(sweeps: Sweeps, cell: Cell, file: object) -> dict[str, Column]:
    """Sweeps as columns in file order, joints in um and deg; optional columns only where they say something.

    Parameters
    ----------
    sweeps
        Measured sweeps or a plan; a plan has no ``dl_um`` and ``sigma_um``.
    file
        Where the columns go, for the message.

    Returns
    -------
    dict
        Arrays of shape (n,): text, float, and for ``signed`` 0 or 1.

    Raises
    ------
    InputError
        If the sweeps are such that the file could not be read back.
    """
    q = np.hstack([sweeps.q_start, sweeps.q_end]) / np.tile(cell.joint_scales, 2)
    table: dict[str, Column] = {name: getattr(sweeps, name) for name in LEADING}
    table |= dict(zip(joint_columns(cell), q.T, strict=True))
    rows = np.arange(2, len(sweeps) + 2)
    for name, values in (("dl_um", sweeps.dl), ("sigma_um", sweeps.sigma)):
        given = ~np.isnan(values)
        if given.any() and not given.all():
            row = int(rows[np.argmin(given)])
            raise located(file, "expected a number in every row or in none", row=row, column=name)
        if given.any():
            table[name] = values
    if "dl_um" in table or not sweeps.signed.all():
        table["signed"] = sweeps.signed.astype(np.uint8)
    for name, plain in (("group", ""), ("kind", "sweep"), ("trace", ""), ("utc", "")):
        if (getattr(sweeps, name) != plain).any():
            table[name] = getattr(sweeps, name)
    if not np.isnan(sweeps.temperature_c).all():
        table["temperature_c"] = sweeps.temperature_c
    from_columns(table, cell, str(file), rows, plan=not sweeps.measured)
    return table


def from_columns(table: Mapping[str, Column], cell: Cell, file: str, rows: NDArray[np.int64], *, plan: bool) -> Sweeps:
    """Sweeps from columns in um and deg whose names `check_names` has passed.

    Parameters
    ----------
    table
        Arrays of shape (n,): text for `TEXTS`, numbers for the others; ``temperature_c`` may be NaN.
    file, rows
        Where the columns come from: name and line of each row, shape (n,).
    plan
        Whether columns other than the joints' may be missing.

    Raises
    ------
    InputError
        If a value is not what its column holds, or the sweeps break a rule of `check_sweeps`.
    """
    if len(rows) == 0:
        raise InputError(f"{file}: no rows, expected at least one sweep")

    def refuse(bad: NDArray[np.bool_], name: str, expected: str) -> None:
        if bad.any():
            first = int(np.argmax(bad))
            found = shown(table[name][first])
            raise located(file, f"{expected}, found {found}", row=int(rows[first]), column=name)

    for name, values in table.items():
        if name in TEXTS:
            refuse(_flags(values, lambda text: len(text) > MAX_TEXT), name, f"expected at most {MAX_TEXT} characters")
            refuse(_flags(values, _CONTROL.search), name, "expected text without control characters")
        elif name == "temperature_c":
            refuse(np.isinf(values), name, "expected a finite number or nothing")
        else:
            refuse(~np.isfinite(values), name, "expected a finite number")
    if "session" in table:
        refuse(table["session"] == "", "session", "expected the name of a session")
    if "utc" in table:
        refuse(_flags(table["utc"], _is_no_time), "utc", "expected ISO 8601 as in 2024-05-01T08:30:00Z")
    if "signed" in table:
        refuse(~np.isin(table["signed"], (0, 1)), "signed", "expected 1 (sign known) or 0 (only the size is known)")
        if "dl_um" in table:
            lost = (table["signed"] == 0) & (table["dl_um"] < 0)
            refuse(lost, "dl_um", "expected a size, zero or more, where signed is 0")

    q = np.column_stack([table[name] for name in joint_columns(cell)]) * np.tile(cell.joint_scales, 2)
    q_start, q_end = np.hsplit(q, 2)
    optional: dict[str, Any] = {name: table[name] for name in (*LEADING, *OPTIONAL) if name in table}
    optional.setdefault("label", [f"row {row}" for row in rows])
    if "kind" in optional:
        optional["kind"] = np.where(optional["kind"] == "", "sweep", optional["kind"])
    sweeps = Sweeps.make(
        q_start,
        q_end,
        dl=table.get("dl_um", np.nan),
        sigma=table.get("sigma_um", np.nan),
        signed=np.asarray(table["signed"]) == 1 if "signed" in table else True,
        file=file,
        rows=rows,
        **optional,
    )
    check_sweeps(sweeps, cell)
    return sweeps


def _flags(column: Column, test: Callable[[str], object]) -> NDArray[np.bool_]:
    # Most texts repeat (sessions, kinds, groups), so each is looked at once.
    texts: list[str] = column.tolist()
    bad = {text for text in set(texts) if test(text)}
    return np.array([text in bad for text in texts]) if bad else np.zeros(len(texts), dtype=bool)


def _is_no_time(text: str) -> bool:
    if text == "":
        return False
    if not _UTC.fullmatch(text):
        return True
    try:
        datetime.fromisoformat(text)
    except ValueError:
        return True
    return False
