"""Recorded sweeps in a MATLAB file.

Variables are named as the columns of an index CSV: one number a row (n by 1), or for texts a cell array (n by 1) of
char. ``t_s``, ``joint`` and ``irradiance_v`` are cell arrays (n by 1) of vectors, the traces; so are the optional
``scan_before_wavelength_nm``, ``scan_before_irradiance_v`` and those of ``scan_after``, with ``[]`` where none is.
"""

import multiprocessing
from collections.abc import Mapping
from concurrent import futures
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import replacing
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.columns import (
    CONDITIONS,
    INDEX,
    SCANS,
    check_names,
    from_columns,
    is_text,
    joint_columns,
    trace_index,
)
from fpcal_bayes.io.hdf5 import MAX_BYTES
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.traces import SCAN_COLUMNS, TRACE_COLUMNS
from fpcal_bayes.model.cell.cell import Cell


def read_mat_index(path: Path, cell: Cell) -> TraceIndex:
    """Read an index from a MATLAB file, whose variables are as the module says."""
    variables = {name: value for name, value in load_variables(path).items() if not name.startswith("__")}
    scan_names = [f"{scan}_{column}" for scan in SCANS for column in SCAN_COLUMNS]
    apart = {*TRACE_COLUMNS, *scan_names, *INDEX}.difference(SCANS)
    for name in (*joint_columns(cell), *TRACE_COLUMNS):
        if name not in variables:
            raise InputError(f"{path}: the variable {name} is missing")
    check_names(list(variables), cell, f"{path}: variables", plan=True, also=apart)
    n = np.size(variables[joint_columns(cell)[0]])
    table = {
        name: mat_texts(path, name, value, n) if is_text(name) else mat_numbers(path, name, value, n)
        for name, value in variables.items()
        if name not in apart
    }
    sweeps = from_columns(table, cell, str(path), np.arange(1, n + 1), plan=True, whole=True)
    unknown = np.full(n, np.nan)
    conditions = [mat_numbers(path, name, variables[name], n) if name in variables else unknown for name in CONDITIONS]
    traces = zip(*(_vectors(path, name, variables[name], n) for name in TRACE_COLUMNS), strict=True)
    scans = [_scans(path, name, variables, n) for name in SCANS]
    return trace_index(sweeps, cell, conditions, traces, scans, str(path))


def write_mat(path: Path, content: Mapping[str, Any]) -> None:
    """Write variables, whole or not at all: texts, numbers, None as NaN, and lists of these as columns."""

    def variable(value: Any) -> Any:
        array = np.asarray(np.nan if value is None else value)
        if array.dtype.kind == "U":
            return value if isinstance(value, str) else array.astype(object)[:, None]
        return array.astype(float)

    with replacing(path) as temporary, temporary.open("wb") as handle:
        scipy.io.savemat(handle, {name: variable(value) for name, value in content.items()}, oned_as="column")


def load_variables(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file, read by a process of its own: some damaged files end the one that reads them."""
    with futures.ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(_load, str(path)).result()
        except futures.BrokenExecutor as error:
            raise InputError(f"{path}: a damaged MATLAB file, expected one that can be read") from error


def _load(path: str) -> dict[str, Any]:
    try:
        if h5py.is_hdf5(path):
            return _load_hdf5(path)
        return dict(scipy.io.loadmat(path, squeeze_me=False, chars_as_strings=True))
    except Exception as error:  # scipy and h5py raise whatever a damaged file leads to
        raise InputError(f"{path}: not a MATLAB file, or a damaged one ({str(error)[:100]})") from None


def _load_hdf5(path: str) -> dict[str, Any]:
    """The variables of a file of version 7.3: arrays lie transposed, cells are references, texts are codes."""
    room = MAX_BYTES

    def value(item: Any) -> Any:
        nonlocal room
        room -= item.nbytes
        if room < 0:
            raise ValueError(f"more than {MAX_BYTES} bytes")
        kind = item.attrs.get("MATLAB_class", b"double")
        if item.attrs.get("MATLAB_empty", 0):
            return np.zeros((0, 0), dtype=object if kind == b"cell" else float)
        array = item[()]
        if kind == b"char":
            return np.array(["".join(map(chr, row)) for row in array.T.tolist()])
        if array.dtype.kind != "O":
            return array.T
        cells = np.empty(array.T.shape, dtype=object)
        for at in np.ndindex(*cells.shape):
            cells[at] = value(file[array.T[at]])
        return cells

    with h5py.File(path) as file:
        return {name: value(item) for name, item in file.items() if isinstance(item, h5py.Dataset)}


def _scans(path: Path, name: str, variables: dict[str, Any], n: int) -> list[tuple[Floats, ...]]:
    names = [f"{name}_{column}" for column in SCAN_COLUMNS]
    if not any(each in variables for each in names):
        return []
    for each in names:
        if each not in variables:
            raise InputError(f"{path}: the variable {each} is missing")
    return list(zip(*(_vectors(path, each, variables[each], n) for each in names), strict=True))


def mat_numbers(path: Path, name: str, value: Any, n: int) -> Floats:
    """A variable that holds n numbers."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.size != n:
        raise InputError(f"{path}: variable {name}: expected {n} numbers, found shape {array.shape}, {array.dtype}")
    return array.astype(float).reshape(-1)


def mat_texts(path: Path, name: str, value: Any, n: int) -> NDArray[np.str_]:
    """A variable that holds n texts."""
    array = np.asarray(value)
    if array.dtype.kind == "U" and array.size == n:
        return array.reshape(-1)
    cells = _cells(path, name, array, n, "texts")
    if any(cell.dtype.kind != "U" and cell.size for cell in cells) or any(cell.size > 1 for cell in cells):
        raise InputError(f"{path}: variable {name}: expected a cell array of {n} texts")
    return np.array([str(cell.reshape(-1)[0]) if cell.size else "" for cell in cells], dtype=np.str_)


def _vectors(path: Path, name: str, value: Any, n: int) -> list[Floats]:
    cells = _cells(path, name, np.asarray(value), n, "vectors of numbers")
    if any(cell.dtype.kind not in "fiub" for cell in cells):
        raise InputError(f"{path}: variable {name}: expected a cell array of {n} vectors of numbers")
    return [cell.astype(float).reshape(-1) for cell in cells]


def _cells(path: Path, name: str, array: NDArray[Any], n: int, what: str) -> list[NDArray[Any]]:
    if array.dtype.kind != "O" or array.size != n:
        raise InputError(f"{path}: variable {name}: expected a cell array of {n} {what}, found shape {array.shape}")
    return [np.asarray(cell) for cell in array.reshape(-1)]
