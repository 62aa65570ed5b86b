"""A user's path from a CSV file."""

from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, largest, located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import read_records

COLUMNS = ("x_um", "y_um", "z_um", "rx_deg", "ry_deg", "rz_deg")


def read_path(path: str | Path) -> Floats:
    """Moves (n, 6) away from the aligned pose in um and rad, from a CSV with the columns `COLUMNS` and n > 1 rows."""
    path = Path(path)
    records = read_records(path, f"the header {','.join(COLUMNS)}")
    records.require_header(COLUMNS)
    numbers = [
        records.numbers(name, texts, finite=True, expected="expected a finite number")
        for name, texts in records.columns().items()
    ]
    shown: Floats = np.column_stack(numbers)
    n = len(shown)
    if n < 2:
        raise InputError(f"{path}: {n} row{'' if n == 1 else 's'}, expected a path of two or more")
    for row, name in np.argwhere(np.abs(shown) > [largest(name) for name in COLUMNS]):
        raise located(
            path, f"expected at most {largest(COLUMNS[name]):g}", row=int(records.rows[row]), column=COLUMNS[name]
        )
    shown *= np.repeat([1.0, np.pi / 180.0], 3)
    return shown
