"""Recorded sweeps in HDF5: an index file of its own, or a part of a campaign file.

Samples of all traces lie one after the other, as do those of all scans; ``*_end`` says where each ends. A file of
thousands of traces thus has few datasets and is read in one go.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import replacing
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.columns import CONDITIONS, SCANS, from_columns, get_columns, put_columns, to_columns
from fpcal_bayes.io.hdf5 import Reader, put_text, reading, writing
from fpcal_bayes.io.traces import unscaled
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint
from fpcal_bayes.measure.traces import Trace, WavelengthScan
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
    joints = [unscaled(trace.joint, scale) for trace, scale in zip(index.traces, scales, strict=True)]
    columns = {
        "trace_end": _ends(index.traces),
        "t_s": _chain([trace.time_s for trace in index.traces]),
        "joint": _chain(joints),
        "irradiance_v": _chain([trace.irradiance for trace in index.traces]),
    }
    put_columns(traces, columns)
    put_text(traces["joint"], "unit", "um or deg, as the joint that moves")
    for name, scans in zip(SCANS, (index.scans_before, index.scans_after), strict=True):
        if any(scan is not None for scan in scans):
            given = [scan or WavelengthScan(np.zeros(0), np.zeros(0)) for scan in scans]
            columns = {
                "scan_end": _ends(given),
                "wavelength_nm": _chain([unscaled(scan.wavelength, 1e-3) for scan in given]),
                "irradiance_v": _chain([scan.irradiance for scan in given]),
            }
            put_columns(group.create_group(name), columns)


def get_index(reader: Reader, group: Any, cell: Cell) -> TraceIndex:
    """Read recorded sweeps from an HDF5 group; `InputError` if anything is not as `put_index` writes it."""
    part = reader.group(group, "sweeps")
    place = f"{reader.path}: {part.name}"
    table = get_columns(reader, part, cell, plan=True)
    n = len(next(iter(table.values())))
    sweeps = from_columns(table, cell, str(reader.path), np.arange(1, n + 1), plan=True, whole=True)

    conditions = reader.group(group, "conditions")
    numbers = [reader.numbers(conditions, name) for name in CONDITIONS]
    if any(len(values) != n for values in numbers):
        raise InputError(f"{reader.path}: {conditions.name}: expected {n} values in every column")
    wavelength_nm, celsius, pressure, humidity = numbers

    part = reader.group(group, "traces")
    columns = [reader.numbers(part, name) for name in ("t_s", "joint", "irradiance_v")]
    parts = _split(reader, part, "trace_end", columns, n)
    traces = [
        Trace(time_s, joint * cell.joint_scales[moving_joint(sweeps, i)], irradiance, f"{place}: trace {i + 1}")
        for i, (time_s, joint, irradiance) in enumerate(parts)
    ]
    before, after = (_scans(reader, group, name, n) for name in SCANS)
    return TraceIndex(sweeps, wavelength_nm * 1e-3, celsius, pressure, humidity, traces, before, after)


def _scans(reader: Reader, group: Any, name: str, n: int) -> list[WavelengthScan | None]:
    if not reader.has(group, name):
        return [None] * n
    part = reader.group(group, name)
    columns = [reader.numbers(part, column) for column in ("wavelength_nm", "irradiance_v")]
    parts = _split(reader, part, "scan_end", columns, n)
    place = f"{reader.path}: {part.name}"
    return [
        WavelengthScan(wavelength * 1e-3, irradiance, f"{place} {i + 1}") if len(wavelength) else None
        for i, (wavelength, irradiance) in enumerate(parts)
    ]


def _split(reader: Reader, part: Any, name: str, columns: list[Floats], n: int) -> list[list[Floats]]:
    """Cut columns at the ends that the dataset `name` tells; n pieces of each column."""
    ends = reader.numbers(part, name)
    place = f"{reader.path}: {part.name}/{name}"
    total = len(columns[0])
    if len(ends) != n or not np.isfinite(ends).all() or (ends != np.round(ends)).any():
        raise InputError(f"{place}: expected {n} whole numbers")
    if any(len(column) != total for column in columns) or (np.diff(ends, prepend=0) < 0).any() or ends[-1] != total:
        raise InputError(f"{place}: expected ends that rise to the number of samples of every column")
    cuts = ends[:-1].astype(np.int64)
    return [list(pieces) for pieces in zip(*(np.split(column, cuts) for column in columns), strict=True)]


def _ends(parts: Sequence[Trace | WavelengthScan]) -> NDArray[np.int64]:
    return np.cumsum([len(part) for part in parts], dtype=np.int64)


def _chain(parts: list[Floats]) -> Floats:
    return np.concatenate(parts) if parts else np.zeros(0)
