"""CSV files of what the photodiode recorded: traces of sweeps, wavelength scans, and paths of several joints.

The file of a path has the columns ``part,t_s`` and the joints, ``q1_um`` .. ``q6_deg``, then ``irradiance_v``; a part
is ``reference`` or ``path``, as `fpcal_bayes.measure.traces.PathTrace` says.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.files import read_text
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import read_numbers, read_records, write_numbers, write_table
from fpcal_bayes.io.formats import is_other, read_named
from fpcal_bayes.io.validate import shown
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


def read_trace(path: str | Path, scale: float, columns: Mapping[str, str] | None = None) -> Trace:
    """A trace from a CSV ``t_s,joint,irradiance_v``, or one of names `columns`; `scale` is um or rad per shown unit."""
    path = Path(path)
    other = is_other(path, ",".join(TRACE_COLUMNS))
    table = read_named(path, TRACE_COLUMNS, columns or {}) if other else read_numbers(path, TRACE_COLUMNS)
    trace = Trace(table[0], table[1] * scale, table[2], str(path))
    check_trace(trace, partial(_line, path))
    return trace


def write_trace(path: str | Path, trace: Trace, scale: float) -> None:
    """Write a trace to a CSV file, whole or not at all; rad that no degrees stand for are off by their last bit."""
    write_numbers(Path(path), TRACE_COLUMNS, (trace.time_s, unscaled(trace.joint, scale), trace.irradiance))


def read_scan(path: str | Path) -> WavelengthScan:
    """A wavelength scan from a CSV file with the columns ``wavelength_nm,irradiance_v``."""
    path = Path(path)
    table = read_numbers(path, SCAN_COLUMNS)
    scan = WavelengthScan(table[0] * 1e-3, table[1], str(path))
    check_scan(scan, partial(_line, path))
    return scan


def write_scan(path: str | Path, scan: WavelengthScan) -> None:
    """Write a wavelength scan to a CSV file, whole or not at all, to the last bit or the one before."""
    write_numbers(Path(path), SCAN_COLUMNS, (unscaled(scan.wavelength, 1e-3), scan.irradiance))


def unscaled(values: Floats, scale: float) -> Floats:
    """Numbers x with x * scale equal to `values` to the last bit, as no quotient is, wherever such numbers exist."""
    quotient = values / scale
    for towards in (-np.inf, np.inf):
        off = quotient * scale != values
        if not off.any():
            break
        near = np.nextafter(values / scale, towards)
        quotient = np.where(off & (near * scale == values), near, quotient)
    return np.asarray(quotient)


def _line(path: Path, sample: int) -> int:
    """Line of a sample in a CSV file, which is looked at again only when a message needs it."""
    return [number for number, line in enumerate(read_text(path).splitlines(), 1) if line.strip()][sample + 1]


def path_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the columns of a path's file."""
    return ("part", "t_s", *cell.joint_columns, "irradiance_v")


def write_path_trace(path: str | Path, trace: PathTrace, cell: Cell) -> None:
    """Write a recorded path, whole or not at all."""
    columns = (np.where(trace.reference, *PARTS), trace.time_s, *(trace.q / cell.joint_scales).T, trace.irradiance)
    write_table(Path(path), dict(zip(path_columns(cell), columns, strict=True)))


def read_path_trace(path: str | Path, cell: Cell) -> PathTrace:
    """A recorded path from a CSV file, in one piece after a reference scan."""
    path = Path(path)
    records = read_records(path)
    names = path_columns(cell)
    records.require_header(names)
    columns, rows = records.columns(), records.rows.tolist()
    for part, row in zip(columns["part"], rows, strict=True):
        if part not in PARTS:
            raise located(path, f"expected {' or '.join(PARTS)}, found {shown(part)}", row=row, column="part")
    numbers = [records.numbers(name, columns[name], finite=True) for name in names[1:]]
    reference = np.array([part == PARTS[0] for part in columns["part"]], dtype=bool)
    q = np.column_stack(numbers[1:-1]) * cell.joint_scales
    trace = PathTrace(numbers[0], q, numbers[-1], reference, file=str(path))
    check_joints(cell, trace.q, path, rows, cell.joint_columns)
    back = np.diff(trace.time_s) <= 0
    if back.any():
        row = rows[int(np.argmax(back)) + 1]
        raise located(path, "expected a later time than in the line before", row=row, column="t_s")
    check_parts(trace, rows)
    return trace
