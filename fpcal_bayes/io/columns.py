"""The columns of sweep, plan and index files: one table of what each holds, and sweeps as columns and back.

CSV, HDF5 and MATLAB readers and writers all work from these.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, largest, located
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.io.csv import Records
from fpcal_bayes.io.hdf5 import Reader, put_array
from fpcal_bayes.io.validate import shown
from fpcal_bayes.measure.protocol import read_often, seen_by_all
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sweeps import MAX_TEXT, Sweeps
from fpcal_bayes.measure.traces import Trace, WavelengthScan
from fpcal_bayes.model.cell.cell import Cell

Column = NDArray[Any]


# Every sweep file has the leading columns, the joints' and the measurement, which a plan may leave out; then come
# optional ones. Those of a plan say how it is to be measured and stand beside no measurement. Those of an index are no
# columns of sweeps. Numbers of the last three may be missing, NaN.
LEADING = ("session", "time_h", "label")
MEASUREMENT = ("dl_um", "sigma_um", "signed")
OPTIONAL = (
    *("group", "kind", "trace", "utc", "temperature_c"),
    *("t_start_h", "t_end_h", "approach", "beam", "shot", "scale_ppm"),
)
PLAN = ("readings", "expires_h", "expires_utc", "ticket")
INDEX = ("wavelength_nm", "pressure_hpa", "humidity_pct", "scan_before", "scan_after")
_TEXTS = ("session", "label", "group", "kind", "trace", "utc", "approach", "beam", "shot")
_OTHER_TEXTS = ("expires_utc", "ticket", "scan_before", "scan_after")
#: What an empty field of the column `kind` means; of other texts it means an empty text.
_DEFAULT_KIND = "sweep"
#: Of an index: the light and the air, in the order of `TraceIndex`, and the files of wavelength scans.
CONDITIONS = ("wavelength_nm", "temperature_c", "pressure_hpa", "humidity_pct")
SCANS = ("scan_before", "scan_after")

#: Ranges of numbers that are narrower than `largest`; a sigma outside stands in another unit.
PLAUSIBLE = {
    "sigma_um": (1e-6, 1e4, "expected a standard deviation above zero, in um: 1e-06 to 10000"),
    "temperature_c": (-200.0, 200.0, "expected a temperature in degrees Celsius, -200 to 200"),
    "scale_ppm": (0.0, 1e5, "expected a standard deviation in parts per million, 0 to 100000"),
}

_UNITS = ("um", "deg", "h", "c", "nm", "hpa", "pct", "s", "v")
_MOST_READINGS = 1000
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_JOINT = re.compile(r"q\d+_(start|end)_(um|deg)")
# Python also reads dates alone and any letter between date and time; a file says both, the usual way.
_UTC = re.compile(r"\d{4}-?\d\d-?\d\d[T ]\d\d(:?\d\d){0,2}([.,]\d+)?(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII)


def is_text(name: str) -> bool:
    """Whether a column holds texts; the others hold numbers."""
    return name in _TEXTS or name in _OTHER_TEXTS


def _may_be_empty(name: str) -> bool:
    return name in OPTIONAL or name in PLAN or name in INDEX


def joint_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the joint columns of a sweep, start pose before end pose: ``q1_start_um`` .. ``q6_end_deg``."""
    split = [name.split("_") for name in cell.joint_columns]
    return tuple(f"{joint}_{end}_{unit}" for end in ("start", "end") for joint, unit in split)


def required_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the columns that every file of measured sweeps has, in their order."""
    return (*LEADING, *joint_columns(cell), *MEASUREMENT)


def check_names(
    names: Sequence[str], cell: Cell, file: object, *, plan: bool, row: int | None = None, also: Collection[str] = ()
) -> None:
    """Hold the names of a file's columns, in its `row`, to those of the cell and those that may stand there `also`."""
    required, joints = required_columns(cell), joint_columns(cell)
    owns = f"cell {cell.name!r} has {len(cell.joints)} joints, {', '.join(cell.joint_columns)}"
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise located(file, f"the column {shown(name)} stands twice", row=row)
        seen.add(name)
        if name in required or name in OPTIONAL or name in also:
            continue
        if _JOINT.fullmatch(name):
            raise located(file, f"column {name} does not fit: {owns}", row=row)
        if name in PLAN and "dl_um" in names:
            raise located(file, f"the column {name} belongs to a plan, expected no column dl_um beside it", row=row)
        if name in PLAN and plan:
            continue
        if name in PLAN:
            raise located(file, f"the column {name} belongs to a plan, expected measured sweeps", row=row)
        expected = f"expected {','.join(required)}, then any of {','.join(OPTIONAL)}"
        raise located(file, f"unknown column {shown(name)}, {expected}", row=row)
    for name in joints if plan else required:
        if name not in seen:
            hint = f": {owns}" if name in joints else ""
            raise located(file, f"the column {name} is missing{hint}", row=row)


def parsed(records: Records) -> dict[str, Column]:
    """The columns of a CSV file whose names `check_names` has passed: texts, or numbers, NaN where one may miss."""
    table: dict[str, Column] = {}
    for name, texts in records.columns().items():
        if is_text(name):
            # A text too long for its column is refused later; cut here, it does not widen every row of the array.
            table[name] = np.array([text[: MAX_TEXT + 1] for text in texts], dtype=np.str_)
        elif _may_be_empty(name):
            known = np.array([text != "" for text in texts])
            table[name] = np.where(known, records.numbers(name, [text or "0" for text in texts]), np.nan)
        else:
            table[name] = records.numbers(name, texts)
    return table


def put_columns(group: Any, table: Mapping[str, Column]) -> None:
    """Store columns in an HDF5 group, with the unit that a name ends in as an attribute."""
    for name, values in table.items():
        unit = name.rpartition("_")[2]
        put_array(group, name, values, unit if unit in _UNITS else "")


def get_columns(reader: Reader, group: Any, cell: Cell, *, plan: bool) -> dict[str, Column]:
    """The columns of sweeps in an HDF5 group; `InputError` if their names or lengths do not fit."""
    names = list(group)
    check_names(names, cell, f"{reader.path}: {group.name}", plan=plan)
    table = {name: reader.texts(group, name) if is_text(name) else reader.numbers(group, name) for name in names}
    joint = joint_columns(cell)[0]
    expected = len(table[joint])
    for name, values in table.items():
        stated, unit = group[name].attrs.get("unit"), name.rpartition("_")[2]
        if stated is not None and unit in _UNITS and reader.text_attribute(group[name], "unit") != unit:
            what = f"{reader.path}: {group.name}/{name}: expected the unit {unit}, found {str(stated)[:20]!r}"
            raise InputError(what)
        if len(values) != expected:
            where = f"{reader.path}: {group.name}/{name}"
            raise InputError(f"{where}: expected {expected} values as in {joint}, found {len(values)}")
    return table


def to_columns(
    sweeps: Sweeps, cell: Cell, file: object, asked: Mapping[str, Column] | None = None
) -> dict[str, Column]:
    """Sweeps, or a plan, as columns (n,) in file order, joints in um and deg; optional ones only if they say something.

    `asked` are columns that say how a plan is to be measured. `InputError` if the file could not be read back.
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
    for name in OPTIONAL:
        values = getattr(sweeps, name)
        nothing = _DEFAULT_KIND if name == "kind" else ""
        if (values != nothing if is_text(name) else ~np.isnan(values)).any():
            table[name] = values
    table |= asked or {}
    from_columns(table, cell, str(file), rows, plan=not sweeps.measured, whole=True)
    return table


def from_columns(
    table: Mapping[str, Column], cell: Cell, file: str, rows: Ints, *, plan: bool, whole: bool = False
) -> Sweeps:
    """Sweeps from columns (n,) in um and deg whose names `check_names` has passed; `InputError` at the first bad value.

    In a plan a sweep becomes as many rows as its `readings` ask for, of each beam where it names none, unless `whole`.
    """
    if len(rows) == 0:
        raise InputError(f"{file}: no rows, expected at least one sweep")

    def refuse(bad: Bools, name: str, expected: str) -> None:
        if bad.any():
            first = int(np.argmax(bad))
            raise located(file, f"{expected}, found {shown(table[name][first])}", row=int(rows[first]), column=name)

    for name, values in table.items():
        if name in INDEX:
            continue
        if is_text(name):
            refuse(_flags(values, lambda text: len(text) > MAX_TEXT), name, f"expected at most {MAX_TEXT} characters")
            refuse(_flags(values, _CONTROL.search), name, "expected text without control characters")
        elif _may_be_empty(name):
            refuse(np.isinf(values), name, "expected a finite number or nothing")
        else:
            refuse(~np.isfinite(values), name, "expected a finite number")
        if not is_text(name):
            most = largest(name)
            low, high, expected = PLAUSIBLE.get(name, (-most, most, f"expected {-most:g} to {most:g}"))
            refuse((values < low) | (values > high), name, expected)
    if "session" in table:
        refuse(table["session"] == "", "session", "expected the name of a session")
    for name in ("utc", "expires_utc"):
        if name in table:
            refuse(_flags(table[name], _is_no_time), name, "expected ISO 8601 as in 2024-05-01T08:30:00Z")
    if "signed" in table:
        refuse(~np.isin(table["signed"], (0, 1)), "signed", "expected 1 (sign known) or 0 (only the size is known)")
        if "dl_um" in table:
            lost = (table["signed"] == 0) & (table["dl_um"] < 0)
            refuse(lost, "dl_um", "expected a size, zero or more, where signed is 0")

    q = np.column_stack([table[name] for name in joint_columns(cell)]) * np.tile(cell.joint_scales, 2)
    q_start, q_end = np.hsplit(q, 2)
    others: dict[str, Any] = {name: table[name] for name in (*LEADING, *OPTIONAL) if name in table}
    others.setdefault("label", [f"row {row}" for row in rows])
    if "kind" in others:
        others["kind"] = np.where(others["kind"] == "", _DEFAULT_KIND, others["kind"])
    sweeps = Sweeps.of_um_rad(
        q_start,
        q_end,
        dl=table.get("dl_um", np.nan),
        sigma=table.get("sigma_um", np.nan),
        signed=np.asarray(table["signed"]) == 1 if "signed" in table else True,
        file=file,
        rows=rows,
        **others,
    )
    check_sweeps(seen_by_all(sweeps, cell) if plan else sweeps, cell)
    readings = readings_of(table, file, rows)
    if whole:
        return sweeps
    what = "a whole trace is recorded by simulate --traces or measure, expected 1 or more here"
    refuse(readings == 0, "readings", what)
    return seen_by_all(read_often(sweeps, readings), cell)


def trace_index(
    sweeps: Sweeps,
    cell: Cell,
    conditions: Sequence[Floats],
    traces: Iterable[tuple[Floats, ...]],
    scans: Sequence[Sequence[tuple[Floats, ...]]],
    file: str,
) -> TraceIndex:
    """Recorded sweeps from columns in the units of files; of scans before and after, if any, empty ones are none."""
    made = [
        Trace(time_s, joint * cell.joint_scales[moving_joint(sweeps, i)], irradiance, f"{file}: trace {i + 1}")
        for i, (time_s, joint, irradiance) in enumerate(traces)
    ]
    before, after = (
        [
            WavelengthScan(wavelength * 1e-3, irradiance, f"{file}: {name} {i}") if len(wavelength) else None
            for i, (wavelength, irradiance) in enumerate(part, 1)
        ]
        or [None] * len(sweeps)
        for name, part in zip(SCANS, scans, strict=True)
    )
    wavelength_nm, celsius, pressure, humidity = conditions
    return TraceIndex(sweeps, wavelength_nm * 1e-3, celsius, pressure, humidity, made, before, after)


def readings_of(table: Mapping[str, Column], file: str, rows: Ints) -> Ints:
    """Readings that a plan asks of each row, 0 for a whole trace; one where it says nothing, shape (n,)."""
    found = table.get("readings", np.ones(len(rows)))
    found = np.where(np.isnan(found), 1.0, found)
    bad = (found != np.round(found)) | (found < 0) | (found > _MOST_READINGS)
    if bad.any():
        expected = f"expected a whole number from 0 to {_MOST_READINGS}, found {found[bad][0]:g}"
        raise located(file, expected, row=int(rows[np.argmax(bad)]), column="readings")
    return found.astype(np.int64)


def _flags(column: Column, test: Callable[[str], object]) -> Bools:
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
