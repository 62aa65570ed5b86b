"""A user's path from a CSV file."""

from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import column_numbers, read_records

COLUMNS = ("x_um", "y_um", "z_um", "rx_deg", "ry_deg", "rz_deg")


def read_path(path: str | Path) -> Floats:
    """Read moves away from the aligned pose.

    Parameters
    ----------
    path
        UTF-8 CSV with the header ``x_um,y_um,z_um,rx_deg,ry_deg,rz_deg`` and two rows or more.

    Returns
    -------
    ndarray
        Shape (n, 6), in um and rad.

    Raises
    ------
    InputError
        If the file is anything else; the message names the line and the column.
    """
    path = Path(path)
    records, lines = read_records(path)
    if not records:
        raise InputError(f"{path}: the file holds no text, expected the header {','.join(COLUMNS)}")
    if tuple(records[0]) != COLUMNS:
        raise located(path, f"expected the header {','.join(COLUMNS)}", row=lines[0])
    rows = np.array(lines[1:], dtype=np.int64)
    for record, row in zip(records[1:], rows.tolist(), strict=True):
        if len(record) != len(COLUMNS):
            raise located(path, f"expected {len(COLUMNS)} fields, found {len(record)}", row=row)
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} row{'' if len(rows) == 1 else 's'}, expected a path of two or more")
    columns = zip(COLUMNS, zip(*records[1:], strict=True), strict=True)
    shown: Floats = np.column_stack([column_numbers(cells, rows, path, name) for name, cells in columns])
    for row, column in np.argwhere(~np.isfinite(shown)):
        raise located(path, "expected a finite number", row=int(rows[row]), column=COLUMNS[column])
    offsets: Floats = shown * np.repeat([1.0, np.pi / 180.0], 3)
    return offsets
