"""Recorded sweeps in HDF5: an index file of its own, or a part of a campaign file.

Samples of all traces lie one after the other, as do those of all scans; ``*_end`` says where each ends. A file of
thousands of traces thus has few datasets and is read in one go.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import replacing
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.io.columns import CONDITIONS, SCANS, from_columns, get_columns, put_columns, to_columns, trace_index
from fpcal_bayes.io.hdf5 import Reader, put_text, reading, writing
from fpcal_bayes.io.traces import unscaled
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint
from fpcal_bayes.measure.traces import SCAN_COLUMNS, TRACE_COLUMNS, WavelengthScan
from fpcal_bayes.model.cell.cell import Cell

SCHEMA = "fpcal-trace-index"
SCHEMA_VERSION = 1


def write_hdf5_index(path: Path, index: TraceIndex, cell: Cell) -> None:
    """Write an index to a file of its own, whole or not at all; equal content gives equal bytes."""
    with replacing(path) as temporary, writing(temporary) as root:
        put_text(root, "schema", SCHEMA)
        root.attrs["schema_version"] = SCHEMA_VERSION
        put_index(root, index, cell, path)


def read_hdf5_index(path: Path, cell: Cell) -> TraceIndex:
    """Read an index from a file that `write_hdf5_index` made, or the recordings of a campaign file."""
    with reading(path) as reader:
        root = reader.root
        schema = reader.text_attribute(root, "schema")
        if schema == "fpcal-campaign" and reader.has(root, "recordings"):
            return get_index(reader, reader.group(root, "recordings"), cell)
        if schema != SCHEMA:
            raise InputError(f"{path}: expected an HDF5 file of schema {SCHEMA} with traces, found {schema!r:.40}")
        version = reader.integer_attribute(root, "schema_version")
        if version != SCHEMA_VERSION:
            raise InputError(f"{path}: schema {version}: this program reads {SCHEMA_VERSION}")
        return get_index(reader, root, cell)


def put_index(group: Any, index: TraceIndex, cell: Cell, file: object) -> None:
    """Store recorded sweeps in an HDF5 group; `InputError` names `file` if they could not be read back."""
    put_columns(group.create_group("sweeps"), to_columns(index.sweeps, cell, file))
    parts = (unscaled(index.wavelength, 1e-3), index.temperature_c, index.pressure_hpa, index.humidity_pct)
    put_columns(group.create_group("conditions"), dict(zip(CONDITIONS, parts, strict=True)))
    traces = group.create_group("traces")
    scales = [cell.joint_scales[moving_joint(index.sweeps, i)] for i in range(len(index))]
    columns = {
        "trace_end": ends_of(index.traces),
        "t_s": _chain([trace.time_s for trace in index.traces]),
        "joint": _chain([unscaled(trace.joint, scale) for trace, scale in zip(index.traces, scales, strict=True)]),
        "irradiance_v": _chain([trace.irradiance for trace in index.traces]),
    }
    put_columns(traces, columns)
    put_text(traces["joint"], "unit", "um or deg, as the joint that moves")
    for name, scans in zip(SCANS, (index.scans_before, index.scans_after), strict=True):
        if any(scan is not None for scan in scans):
            given = [scan or WavelengthScan(np.zeros(0), np.zeros(0)) for scan in scans]
            columns = {
                "scan_end": ends_of(given),
                "wavelength_nm": _chain([unscaled(scan.wavelength, 1e-3) for scan in given]),
                "irradiance_v": _chain([scan.irradiance for scan in given]),
            }
            put_columns(group.create_group(name), columns)


def get_index(reader: Reader, group: Any, cell: Cell) -> TraceIndex:
    """Read recorded sweeps from an HDF5 group; `InputError` if anything is not as `put_index` writes it."""
    table = get_columns(reader, reader.group(group, "sweeps"), cell, plan=True)
    n = len(next(iter(table.values())))
    sweeps = from_columns(table, cell, str(reader.path), np.arange(1, n + 1), plan=True, whole=True)

    conditions = reader.group(group, "conditions")
    numbers = [reader.numbers(conditions, name) for name in CONDITIONS]
    if any(len(values) != n for values in numbers):
        raise InputError(f"{reader.path}: {conditions.name}: expected {n} values in every column")
    traces = get_pieces(reader, reader.group(group, "traces"), "trace_end", TRACE_COLUMNS, n)
    scans = [
        get_pieces(reader, reader.group(group, name), "scan_end", SCAN_COLUMNS, n) if reader.has(group, name) else []
        for name in SCANS
    ]
    return trace_index(sweeps, cell, numbers, traces, scans, f"{reader.path}: {group.name}")


def get_pieces(reader: Reader, part: Any, end: str, names: Sequence[str], n: int) -> list[tuple[Floats, ...]]:
    """Columns of a group cut at the ends that its dataset `end` tells: n pieces of each."""
    columns, ends = [reader.numbers(part, name) for name in names], reader.numbers(part, end)
    total = len(columns[0])
    whole = len(ends) == n and np.isfinite(ends).all() and (ends == np.round(ends)).all()
    rising = whole and (np.diff(ends, prepend=0) >= 0).all() and (ends[-1] if n else 0) == total
    if not rising or any(len(column) != total for column in columns):
        raise InputError(f"{reader.path}: {part.name}/{end}: expected whole numbers that rise to {total}, {n} of them")
    return list(zip(*(np.split(column, ends[:-1].astype(np.int64))[:n] for column in columns), strict=True))


def ends_of(parts: Sequence[Any]) -> Ints:
    """Where each of some parts, which lie one after the other, ends."""
    return np.cumsum([len(part) for part in parts], dtype=np.int64)


def _chain(parts: list[Floats]) -> Floats:
    return np.concatenate(parts) if parts else np.zeros(0)
