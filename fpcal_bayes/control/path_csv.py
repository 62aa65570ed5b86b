"""A user's path from a CSV file."""

import csv
import io
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError, located
from fpcal_bayes.files import read_text, require_line_end

COLUMNS = ("x_um", "y_um", "z_um", "rx_deg", "ry_deg", "rz_deg")

# float() reads more than a file should hold: 1_000, infinity, digits of other scripts.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def read_path(path: str | Path) -> NDArray[np.float64]:
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
    text = read_text(path)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[list[float]] = []
    header: list[str] | None = None
    try:
        for record in reader:
            if not record or record == [""]:
                continue
            if header is None:
                header = record
                if tuple(header) != COLUMNS:
                    raise located(path, f"expected the header {','.join(COLUMNS)}", row=reader.line_num)
                continue
            rows.append(_row(path, record, reader.line_num))
    except csv.Error as error:
        raise located(path, f"not a line of CSV ({error})", row=max(reader.line_num, 1)) from error
    if header is None:
        raise InputError(f"{path}: the file holds no text, expected the header {','.join(COLUMNS)}")
    require_line_end(path, text)
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} row{'' if len(rows) == 1 else 's'}, expected a path of two or more")
    offsets: NDArray[np.float64] = np.array(rows) * np.repeat([1.0, np.pi / 180.0], 3)
    return offsets


def _row(path: Path, record: list[str], line: int) -> list[float]:
    if len(record) != len(COLUMNS):
        raise located(path, f"expected {len(COLUMNS)} fields, found {len(record)}", row=line)
    for name, text in zip(COLUMNS, record, strict=True):
        if not _NUMBER.fullmatch(text) or not math.isfinite(float(text)):
            found = f"found {text[:40]!r}" if text else "found nothing"
            raise located(path, f"expected a finite number, {found}", row=line, column=name)
    return [float(text) for text in record]
