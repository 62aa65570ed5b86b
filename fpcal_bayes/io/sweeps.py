"""Sweeps from and to a file of either format: CSV or HDF5."""

import zlib
from base64 import b64decode, b64encode
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import exclusive, require_readable, require_suffix
from fpcal_bayes.core.typing import Ints
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.columns import Column, check_names, from_columns, parsed, required_columns, to_columns
from fpcal_bayes.io.csv import Records, read_blocks, table_text, write_table
from fpcal_bayes.io.hdf5 import is_hdf5
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cell.cell import Cell

HDF5_SUFFIXES = (".h5", ".hdf5")
#: Characters of packed sweeps, and of their CSV.
_MOST_PACKED, _MOST_UNPACKED = 75_000, 20_000_000
#: Rows of a CSV file whose texts are held at once.
_ROWS_AT_ONCE = 5000


def is_campaign_file(path: str | Path) -> bool:
    """Whether a file is to be read as HDF5: it begins like one or is called ``.h5`` or ``.hdf5``."""
    path = Path(path)
    require_readable(path)
    return path.suffix.lower() in HDF5_SUFFIXES or is_hdf5(path)


def read_sweeps(path: str | Path, cell: Cell, *, plan: bool = False, whole: bool = False) -> Sweeps:
    """Read sweeps from a CSV file or a campaign file.

    Parameters
    ----------
    path
        HDF5 if `is_campaign_file`, else CSV.
    plan
        Accept sweeps without measurement too; a sweep with `readings` becomes as many rows.
    whole
        Keep such a sweep whole.

    Raises
    ------
    InputError
        If anything in the file is not as documented.
    """
    if is_campaign_file(path):
        return read_campaign(path, cell, plan=plan, whole=whole).sweeps
    return read_csv(path, cell, plan=plan, whole=whole)


def write_sweeps(path: str | Path, sweeps: Sweeps, cell: Cell, **beside: Any) -> None:
    """Write sweeps in the format that the file's suffix names: ``.csv``, ``.h5`` or ``.hdf5``.

    Parameters
    ----------
    beside
        What a campaign file alone keeps: ``command``, ``seed``, ``truth``, ``recordings``, ``doubtful``, ``about``.

    Raises
    ------
    InputError
        If the suffix is another one, or the file cannot be written.
    """
    require_suffix(Path(path), ".csv", *HDF5_SUFFIXES)
    if Path(path).suffix.lower() == ".csv":
        write_csv(path, sweeps, cell)
    else:
        write_campaign(path, Campaign.of(sweeps, cell, **beside), cell)


def append_sweeps(path: str | Path, sweeps: Sweeps, cell: Cell, check: Callable[[Sweeps], object] = len) -> Sweeps:
    """Add measured sessions to a file of sweeps, under the lock of its writers; all that it holds now.

    `check` sees all sweeps first: where it raises `InputError` the file stays. Other content of a campaign is kept.
    """
    path = Path(path)
    if not sweeps.measured:
        raise InputError(f"{sweeps.file}: expected measured sweeps, with dl_um and sigma_um")
    with exclusive(path):
        campaign = read_campaign(path, cell) if is_campaign_file(path) else None
        before = read_csv(path, cell) if campaign is None else campaign.sweeps
        for name in sweeps.sessions:
            if name in before.sessions:
                raise InputError(f"{path}: session {name!r} is there already, expected a new one")
        joined = join([before, sweeps], file=str(path))
        check(joined)
        if campaign is None:
            write_csv(path, joined, cell)
        else:
            write_campaign(path, replace(campaign, sweeps=joined), cell)
    return joined


def read_csv(
    path: str | Path, cell: Cell, *, plan: bool = False, whole: bool = False, text: str | None = None
) -> Sweeps:
    """Read sweeps from a CSV file, or from its `text`; their `rows` are lines of the file, the header being line 1."""
    path = Path(path)
    tables: list[dict[str, Column]] = []
    rows: list[Ints] = []
    for records in read_blocks(path, "a header and sweeps", text, _ROWS_AT_ONCE):
        if not tables:
            _check_header(records, cell, plan=plan)
        tables.append(parsed(records))
        rows.append(records.rows)
    table = {name: np.concatenate([part.pop(name) for part in tables]) for name in list(tables[0])}
    return from_columns(table, cell, str(path), np.concatenate(rows), plan=plan, whole=whole)


def _check_header(records: Records, cell: Cell, *, plan: bool) -> None:
    header, row = records.header, records.header_row
    check_names(header, cell, records.path, plan=plan, row=row)
    required = list(required_columns(cell))
    if not plan and header[: len(required)] != required:
        place = next(i for i, name in enumerate(required) if header[i] != name)
        raise located(records.path, f"expected the column {required[place]}, found {header[place]}", row=row)


def packed(sweeps: Sweeps, cell: Cell) -> str | None:
    """Measured sweeps as text that travels with a result: compressed CSV; None if it is too long or lacks something."""
    if sweeps.common.any() or len(sweeps) > _MOST_PACKED:
        return None
    text = b64encode(zlib.compress(table_text(to_columns(sweeps, cell, sweeps.file)).encode(), 9)).decode()
    return text if len(text) <= _MOST_PACKED else None


def unpacked(text: str, path: str | Path, cell: Cell) -> Sweeps:
    """Sweeps that `packed` wrote; `InputError`, which names the file `path` that they stood in, if it did not."""
    try:
        plain = zlib.decompressobj().decompress(b64decode(text, validate=True), _MOST_UNPACKED).decode()
    except (ValueError, zlib.error) as error:
        raise InputError(f"{path}: key rows: expected the sweeps that fpcal packed there ({error})") from error
    return read_csv(path, cell, text=plain)


def write_csv(path: str | Path, sweeps: Sweeps, cell: Cell) -> None:
    """Write sweeps to a CSV file, whole or not at all; a plan's file has no columns ``dl_um``, ``sigma_um``."""
    write_table(Path(path), to_columns(sweeps, cell, path))
