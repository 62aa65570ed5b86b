"""Recorded sweeps as a CSV that names the files of traces and scans."""

import csv
import io
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.files import make_folder, write_text
from fpcal_bayes.io.columns import MEASUREMENT, TEXTS, Column, check_names, from_columns, shown, to_columns
from fpcal_bayes.io.csv import column_numbers, formatted, read_records
from fpcal_bayes.io.traces import read_scan, read_trace, write_scan, write_trace
from fpcal_bayes.measure.recordings import CONDITIONS, SCANS, TraceIndex, moving_joint, no_trace
from fpcal_bayes.measure.sweeps import MAX_TEXT
from fpcal_bayes.measure.traces import Trace, WavelengthScan
from fpcal_bayes.model.cell.cell import Cell

_ADDED = ("wavelength_nm", "pressure_hpa", "humidity_pct", *SCANS)


def read_csv_index(path: Path, cell: Cell) -> TraceIndex:
    """Read an index and the files that it names.

    Raises
    ------
    InputError
        If anything in the index or those files is not as documented, or a file lies outside the index's folder.
    """
    records, lines = read_records(path)
    if not records:
        raise located(path, "the file holds no text, expected a header and sweeps")
    header = records.pop(0)
    rows = np.array(lines[1:], dtype=np.int64)
    _check_header(path, header, cell, lines[0])
    for record, row in zip(records, rows.tolist(), strict=True):
        if len(record) != len(header):
            raise located(path, f"expected {len(header)} fields, found {len(record)}", row=row)
    n = len(rows)
    table: dict[str, Column] = {}
    for name, fields in zip(header, zip(*records, strict=True), strict=False):
        if name in TEXTS or name in SCANS:
            table[name] = np.array([text[: MAX_TEXT + 1] for text in fields], dtype=np.str_)
        elif name in CONDITIONS:
            known = np.array([text != "" for text in fields])
            table[name] = np.where(known, column_numbers([text or "0" for text in fields], rows, path, name), np.nan)
        else:
            table[name] = column_numbers(fields, rows, path, name)
    plan = {name: values for name, values in table.items() if name not in _ADDED}
    sweeps = from_columns(plan, cell, str(path), rows, plan=True)

    def condition(name: str) -> Column:
        return table.get(name, np.full(n, np.nan))

    def named(name: str, i: int) -> Path | None:
        text = str(table[name][i]) if name in table else ""
        return inner_path(path, text, int(rows[i]), name) if text else None

    def trace_of(i: int) -> Trace:
        file = named("trace", i)
        return no_trace() if file is None else read_trace(file, float(cell.joint_scales[moving_joint(sweeps, i)]))

    def scan_of(name: str, i: int) -> WavelengthScan | None:
        file = named(name, i)
        return None if file is None else read_scan(file)

    return TraceIndex(
        sweeps=sweeps,
        wavelength=condition("wavelength_nm") * 1e-3,
        temperature_c=condition("temperature_c"),
        pressure_hpa=condition("pressure_hpa"),
        humidity_pct=condition("humidity_pct"),
        traces=[trace_of(i) for i in range(n)],
        scans_before=[scan_of("scan_before", i) for i in range(n)],
        scans_after=[scan_of("scan_after", i) for i in range(n)],
    )


def write_csv_index(path: Path, index: TraceIndex, cell: Cell) -> None:
    """Write an index, and its traces and scans to the folder ``<name>_traces`` beside it.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    folder = path.parent / f"{path.stem}_traces"
    make_folder(folder)
    n = len(index)
    names: dict[str, list[str]] = {"trace": [], "scan_before": [], "scan_after": []}
    digits = len(str(n))
    for i, trace in enumerate(index.traces):
        stem = f"{i + 1:0{digits}d}"
        names["trace"].append(f"{folder.name}/{stem}.csv" if len(trace) else "")
        if len(trace):
            write_trace(folder / f"{stem}.csv", trace, float(cell.joint_scales[moving_joint(index.sweeps, i)]))
        for name, scan in zip(SCANS, (index.scans_before[i], index.scans_after[i]), strict=True):
            names[name].append("" if scan is None else f"{folder.name}/{stem}_{name}.csv")
            if scan is not None:
                write_scan(folder / f"{stem}_{name}.csv", scan)
    table: dict[str, Any] = to_columns(index.sweeps, cell, path)
    table["trace"] = np.array(names["trace"])
    parts = (index.wavelength * 1e3, index.temperature_c, index.pressure_hpa, index.humidity_pct)
    table.pop("temperature_c", None)
    table |= {name: part for name, part in zip(CONDITIONS, parts, strict=True) if not np.isnan(part).all()}
    table |= {name: np.array(names[name]) for name in SCANS if any(names[name])}
    columns = [formatted(values) if values.dtype.kind == "f" else values.tolist() for values in table.values()]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*columns, strict=True))
    write_text(path, text.getvalue())


def inner_path(index: Path, name: str, row: int, column: str) -> Path:
    """The file that an index names, which must lie in the folder of the index or below.

    Raises
    ------
    InputError
        If the name is absolute, climbs out with ``..`` or by a link, or no such file exists.
    """
    place = f"{shown(name)}: expected a path inside the folder of the index"
    if len(name) > MAX_TEXT or not name.isprintable():
        raise located(index, place, row=row, column=column)
    parts = PureWindowsPath(name).parts
    if Path(name).is_absolute() or PureWindowsPath(name).anchor or ".." in parts:
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


def _check_header(path: Path, header: list[str], cell: Cell, row: int) -> None:
    for name in MEASUREMENT:
        if name in header:
            raise located(path, f"an index of traces has no column {name}: these are sweeps, not traces", row=row)
    for name in _ADDED:
        if header.count(name) > 1:
            raise located(path, f"the column {name} stands twice", row=row)
    if "trace" not in header:
        raise located(path, "the column trace is missing: expected the file of each sweep's trace", row=row)
    check_names([name for name in header if name not in _ADDED], cell, path, plan=True, row=row)
