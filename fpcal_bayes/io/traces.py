"""Recorded irradiance: along a sweep (a trace) and against the wavelength at rest (a scan), in memory and as CSV."""

import re
import warnings
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import read_text, require_line_end, write_text
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import column_numbers, read_records
from fpcal_bayes.measure.traces import (
    PARTS,
    SCAN_COLUMNS,
    TRACE_COLUMNS,
    PathTrace,
    Trace,
    WavelengthScan,
    check_parts,
    check_scan,
    check_trace,
)
from fpcal_bayes.model.cell.cell import Cell, check_joints

#: Samples of one file; a longer one is no sweep.
MAX_SAMPLES = 20_000_000

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def read_trace(path: str | Path, scale: float) -> Trace:
    """Read a trace from a CSV file with the columns ``t_s,joint,irradiance_v``.

    Parameters
    ----------
    scale
        Internal units per shown unit of the joint: 1 for um, pi / 180 for deg.

    Raises
    ------
    InputError
        If the file is missing, holds anything but finite numbers, or time does not run forwards.
    """
    path = Path(path)
    table = _read_columns(path, TRACE_COLUMNS)
    trace = Trace(table[0], table[1] * scale, table[2], str(path))
    check_trace(trace, _line_of(path))
    return trace


def write_trace(path: str | Path, trace: Trace, scale: float) -> None:
    """Write a trace to a CSV file, whole or not at all; `read_trace` reads the same numbers back.

    A joint in rad that no number of degrees stands for is off by its last bit.

    Parameters
    ----------
    scale
        Internal units per shown unit of the joint.
    """
    _write_columns(Path(path), TRACE_COLUMNS, (trace.time_s, unscaled(trace.joint, scale), trace.irradiance))


def read_scan(path: str | Path) -> WavelengthScan:
    """Read a wavelength scan from a CSV file with the columns ``wavelength_nm,irradiance_v``.

    Raises
    ------
    InputError
        If the file is missing, holds anything but finite numbers, or the wavelength turns back.
    """
    path = Path(path)
    table = _read_columns(path, SCAN_COLUMNS)
    scan = WavelengthScan(table[0] * 1e-3, table[1], str(path))
    check_scan(scan, _line_of(path))
    return scan


def write_scan(path: str | Path, scan: WavelengthScan) -> None:
    """Write a wavelength scan to a CSV file, whole or not at all, to the last bit or the one before."""
    _write_columns(Path(path), SCAN_COLUMNS, (unscaled(scan.wavelength, 1e-3), scan.irradiance))


def unscaled(values: Floats, scale: float) -> Floats:
    """Numbers x with x * scale equal to `values` to the last bit wherever such numbers exist.

    A quotient alone is off by a bit now and then, and a file read back would differ from what was written.
    """
    shown = values / scale
    for towards in (-np.inf, np.inf):
        off = shown * scale != values
        if not off.any():
            break
        near = np.nextafter(values / scale, towards)
        shown = np.where(off & (near * scale == values), near, shown)
    return np.asarray(shown)


class _LineOf:
    """Line of a sample in a CSV file; the file is looked at again only when a message needs it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __call__(self, sample: int) -> int:
        filled = [number for number, line in enumerate(read_text(self.path).splitlines(), 1) if line.strip()]
        return filled[sample + 1]


def _line_of(path: Path) -> _LineOf:
    return _LineOf(path)


def _read_columns(path: Path, names: tuple[str, ...]) -> Floats:
    """The columns of a CSV file of numbers, shape (n_columns, n)."""
    text = read_text(path)
    head, _, body = text.lstrip("\r\n").partition("\n")
    if tuple(head.strip().split(",")) != names:
        raise located(path, f"expected the header {','.join(names)}", row=1)
    if not body.strip():
        raise InputError(f"{path}: no samples under the header")
    if body.count("\n") > MAX_SAMPLES:
        raise InputError(f"{path}: more than {MAX_SAMPLES} samples")
    lines = body.strip().replace("\r\n", "\n").encode()
    marks = np.frombuffer(lines, dtype=np.uint8)
    breaks = np.flatnonzero(marks == ord("\n"))
    commas = np.searchsorted(np.flatnonzero(marks == ord(",")), np.append(breaks, len(marks)))
    if (np.diff(commas, prepend=0) != len(names) - 1).any():
        # Blank lines are let through; everything else is a fault.
        filled = [line for line in lines.decode().split("\n") if line.strip()]
        if any(line.count(",") != len(names) - 1 for line in filled):
            raise _first_fault(path, text, names)
        lines = "\n".join(filled).encode()
    try:
        with warnings.catch_warnings():
            # The text reader warns, and stops, at what is not a number.
            warnings.simplefilter("error")
            table = np.fromstring(lines.replace(b"\n", b","), sep=",")
    except (DeprecationWarning, ValueError) as error:
        raise _first_fault(path, text, names) from error
    if len(table) % len(names) or not np.isfinite(table).all():
        raise _first_fault(path, text, names)
    require_line_end(path, text)
    return np.ascontiguousarray(table.reshape(-1, len(names)).T)


def _first_fault(path: Path, text: str, names: tuple[str, ...]) -> InputError:
    """The message for the first field that is no number, or the first line with too many or too few fields."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    for number, line in lines[1:]:
        fields = line.split(",")
        if len(fields) != len(names):
            return located(path, f"expected {len(names)} fields, found {len(fields)}", row=number)
        for name, field in zip(names, fields, strict=True):
            if not _NUMBER.fullmatch(field.strip()):
                found = f"found {field[:40]!r}" if field.strip() else "found nothing"
                return located(path, f"expected a number, {found}", row=number, column=name)
    return InputError(f"{path}: expected lines of {len(names)} numbers")


def _write_columns(path: Path, names: tuple[str, ...], columns: tuple[Floats, ...]) -> None:
    # repr gives the shortest text that reads back as the same number; adding zero turns -0 into 0.
    texts = [map(repr, (column + 0.0).tolist()) for column in columns]
    lines = "\n".join(map(",".join, zip(*texts, strict=True)))
    write_text(path, f"{','.join(names)}\n{lines}\n")


def path_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the columns of a path's file."""
    return ("part", "t_s", *cell.joint_columns, "irradiance_v")


def write_path_trace(path: str | Path, trace: PathTrace, cell: Cell) -> None:
    """Write a recorded path, whole or not at all."""
    shown = trace.q / cell.joint_scales
    numbers = np.column_stack([trace.time_s, shown, trace.irradiance]) + 0.0
    parts = np.where(trace.reference, *PARTS).tolist()
    lines = [",".join([part, *(f"{x:.13g}" for x in row)]) for part, row in zip(parts, numbers.tolist(), strict=True)]
    write_text(Path(path), "\n".join([",".join(path_columns(cell)), *lines]) + "\n")


def read_path_trace(path: str | Path, cell: Cell) -> PathTrace:
    """Read a recorded path.

    Raises
    ------
    InputError
        If the file is not as documented, a joint leaves its limits, time runs backwards, the path is not in one piece
        after a reference scan, or a part has fewer than 8 samples.
    """
    path = Path(path)
    columns = path_columns(cell)
    records, lines = read_records(path)
    if not records or tuple(records[0]) != columns:
        raise located(path, f"expected the header {','.join(columns)}", row=lines[0] if lines else 1)
    rows = lines[1:]
    for record, row in zip(records[1:], rows, strict=True):
        if len(record) != len(columns):
            raise located(path, f"expected {len(columns)} fields, found {len(record)}", row=row)
        if record[0] not in PARTS:
            raise located(path, f"expected {' or '.join(PARTS)}, found {record[0][:40]!r}", row=row, column="part")
    fields = list(zip(*records[1:], strict=True)) or [()] * len(columns)
    numbers = [
        column_numbers(cells, np.array(rows, dtype=np.int64), path, name)
        for name, cells in zip(columns[1:], fields[1:], strict=True)
    ]
    reference = np.array([part == PARTS[0] for part in fields[0]], dtype=bool)
    q = np.column_stack(numbers[1:-1]) * cell.joint_scales
    trace = PathTrace(numbers[0], q, numbers[-1], reference, file=str(path))
    for name, values in zip(columns[1:], numbers, strict=True):
        if not np.isfinite(values).all():
            raise located(path, "expected a finite number", row=rows[int(np.argmin(np.isfinite(values)))], column=name)
    check_joints(cell, trace.q, path, rows, cell.joint_columns)
    back = np.diff(trace.time_s) <= 0
    if back.any():
        row = rows[int(np.argmax(back)) + 1]
        raise located(path, "expected a later time than in the line before", row=row, column="t_s")
    check_parts(trace, rows)
    return trace
