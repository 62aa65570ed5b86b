"""Recorded sweeps from and to files: an index as CSV that names its traces, or HDF5 or MATLAB that holds them."""

from collections.abc import Mapping
from pathlib import Path, PureWindowsPath

import numpy as np

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.files import make_folder, require_readable, require_suffix
from fpcal_bayes.io.columns import (
    CONDITIONS,
    INDEX,
    MEASUREMENT,
    SCANS,
    Column,
    check_names,
    from_columns,
    parsed,
    to_columns,
)
from fpcal_bayes.io.csv import read_records, write_table
from fpcal_bayes.io.hdf5 import is_hdf5
from fpcal_bayes.io.recordings_hdf5 import read_hdf5_index, write_hdf5_index
from fpcal_bayes.io.recordings_mat import read_mat_index
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES
from fpcal_bayes.io.traces import read_scan, read_trace, write_scan, write_trace
from fpcal_bayes.io.validate import shown
from fpcal_bayes.measure.recordings import TraceIndex, check_index, moving_joint, no_trace
from fpcal_bayes.measure.sweeps import MAX_TEXT
from fpcal_bayes.measure.traces import Trace, WavelengthScan
from fpcal_bayes.model.cell.cell import Cell

_MAT_SUFFIX = ".mat"


def read_recordings(path: str | Path, cell: Cell, columns: Mapping[str, str] | None = None) -> TraceIndex:
    """Read recorded sweeps from a CSV that names its traces, HDF5 or MATLAB; `columns` as in `read_trace`."""
    cell.require_one_beam("a file of recordings")
    path = Path(path)
    require_readable(path)
    suffix = path.suffix.lower()
    if suffix in HDF5_SUFFIXES or (suffix != _MAT_SUFFIX and is_hdf5(path)):
        index = read_hdf5_index(path, cell)
    elif suffix == _MAT_SUFFIX:
        index = read_mat_index(path, cell)
    else:
        index = _read_csv_index(path, cell, columns or {})
    check_index(index, cell)
    return index


def write_recordings(path: str | Path, index: TraceIndex, cell: Cell) -> None:
    """Write recorded sweeps as ``.csv``, with a folder ``INDEX_traces`` beside it, ``.h5`` or ``.hdf5``."""
    path = Path(path)
    check_index(index, cell)
    require_suffix(path, ".csv", *HDF5_SUFFIXES)
    (_write_csv_index if path.suffix.lower() == ".csv" else write_hdf5_index)(path, index, cell)


def _read_csv_index(path: Path, cell: Cell, columns: Mapping[str, str]) -> TraceIndex:
    records = read_records(path, "a header and sweeps")
    for name in MEASUREMENT:
        if name in records.header:
            what = f"an index of traces has no column {name}: these are sweeps, not traces"
            raise located(path, what, row=records.header_row)
    if "trace" not in records.header:
        what = "the column trace is missing: expected the file of each sweep's trace"
        raise located(path, what, row=records.header_row)
    check_names(records.header, cell, path, plan=True, row=records.header_row, also=INDEX)
    table = parsed(records)
    rows = records.rows
    sweeps = from_columns(table, cell, str(path), rows, plan=True, whole=True)
    n = len(sweeps)

    def named(name: str, i: int) -> Path | None:
        text = str(table[name][i]) if name in table else ""
        return _inner_path(path, text, int(rows[i]), name) if text else None

    def trace_of(i: int) -> Trace:
        file = named("trace", i)
        if file is None:
            return no_trace()
        return read_trace(file, float(cell.joint_scales[moving_joint(sweeps, i)]), columns)

    def scan_of(name: str, i: int) -> WavelengthScan | None:
        file = named(name, i)
        return None if file is None else read_scan(file)

    wavelength_nm, celsius, pressure, humidity = (table.get(name, np.full(n, np.nan)) for name in CONDITIONS)
    traces = [trace_of(i) for i in range(n)]
    before, after = ([scan_of(name, i) for i in range(n)] for name in SCANS)
    return TraceIndex(sweeps, wavelength_nm * 1e-3, celsius, pressure, humidity, traces, before, after)


def _write_csv_index(path: Path, index: TraceIndex, cell: Cell) -> None:
    folder = path.parent / f"{path.stem}_traces"
    make_folder(folder)
    names: dict[str, list[str]] = {"trace": [], "scan_before": [], "scan_after": []}
    digits = len(str(len(index)))
    for i, trace in enumerate(index.traces):
        stem = f"{i + 1:0{digits}d}"
        names["trace"].append(f"{folder.name}/{stem}.csv" if len(trace) else "")
        if len(trace):
            write_trace(folder / f"{stem}.csv", trace, float(cell.joint_scales[moving_joint(index.sweeps, i)]))
        for name, scan in zip(SCANS, (index.scans_before[i], index.scans_after[i]), strict=True):
            names[name].append("" if scan is None else f"{folder.name}/{stem}_{name}.csv")
            if scan is not None:
                write_scan(folder / f"{stem}_{name}.csv", scan)
    table: dict[str, Column] = to_columns(index.sweeps, cell, path)
    table["trace"] = np.array(names["trace"])
    parts = (index.wavelength * 1e3, index.temperature_c, index.pressure_hpa, index.humidity_pct)
    table.pop("temperature_c", None)
    table |= {name: part for name, part in zip(CONDITIONS, parts, strict=True) if not np.isnan(part).all()}
    table |= {name: np.array(names[name]) for name in SCANS if any(names[name])}
    write_table(path, table)


def _inner_path(index: Path, name: str, row: int, column: str) -> Path:
    """The file that an index names, in the folder of the index or below, else `InputError`."""
    place = f"{shown(name)}: expected a path inside the folder of the index"
    path = PureWindowsPath(name)
    if len(name) > MAX_TEXT or not name.isprintable() or Path(name).is_absolute() or path.anchor or ".." in path.parts:
        raise located(index, place, row=row, column=column)
    folder, file = index.parent.resolve(), index.parent / name
    try:
        inside = file.resolve().is_relative_to(folder)
        exists = file.is_file()
    except (OSError, RuntimeError) as error:
        raise located(index, place, row=row, column=column) from error
    if not inside:
        raise located(index, place, row=row, column=column)
    if not exists:
        raise located(index, f"{shown(name)}: no such file", row=row, column=column)
    return file
