"""Recorded sweeps from and to files: an index as CSV that names its traces, or HDF5 or MATLAB that holds them."""

from collections.abc import Mapping
from pathlib import Path

from fpcal_bayes.core.files import require_readable, require_suffix
from fpcal_bayes.io.hdf5 import is_hdf5
from fpcal_bayes.io.recordings_csv import read_csv_index, write_csv_index
from fpcal_bayes.io.recordings_hdf5 import read_hdf5_index, write_hdf5_index
from fpcal_bayes.io.recordings_mat import read_mat_index
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES
from fpcal_bayes.measure.recordings import TraceIndex, check_index
from fpcal_bayes.model.cell.cell import Cell

_MAT_SUFFIX = ".mat"


def read_recordings(path: str | Path, cell: Cell, columns: Mapping[str, str] | None = None) -> TraceIndex:
    """Read recorded sweeps with their traces and scans.

    path: A CSV, whose traces lie in files named relative to it; or an HDF5 or MATLAB file that holds everything.
    columns: what the files of traces call the columns that they call otherwise.
    """
    cell.require_one_beam("a file of recordings")
    path = Path(path)
    require_readable(path)
    suffix = path.suffix.lower()
    if suffix in HDF5_SUFFIXES or (suffix != _MAT_SUFFIX and is_hdf5(path)):
        index = read_hdf5_index(path, cell)
    elif suffix == _MAT_SUFFIX:
        index = read_mat_index(path, cell)
    else:
        index = read_csv_index(path, cell, columns or {})
    check_index(index, cell)
    return index


def write_recordings(path: str | Path, index: TraceIndex, cell: Cell) -> None:
    """Write recorded sweeps in the format that the suffix names: ``.csv``, ``.h5`` or ``.hdf5``.

    A CSV gets a folder for its traces and scans beside it: ``INDEX_traces`` for ``INDEX.csv``.
    """
    path = Path(path)
    check_index(index, cell)
    require_suffix(path, ".csv", *HDF5_SUFFIXES)
    write = write_csv_index if path.suffix.lower() == ".csv" else write_hdf5_index
    write(path, index, cell)
