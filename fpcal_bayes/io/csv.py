"""Sweeps in CSV files."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import read_text, require_line_end, write_text
from fpcal_bayes.io.columns import TEXTS, Column, check_names, from_columns, required_columns, shown, to_columns
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell

# float() reads more than a file should hold (1_000, infinity, digits of other scripts). Of texts made of these
# characters it reads decimal and scientific notation only.
_NUMBER_CHARACTERS = frozenset("0123456789+-.eE")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")

#: Digits written: 1e-9 um of a cavity length and 1e-12 of an angle survive, the noise of deg to rad and back does not.
_DIGITS = 13


def read_csv(path: str | Path, cell: Cell, *, plan: bool = False) -> Sweeps:
    """Read sweeps from a CSV file.

    Parameters
    ----------
    path
        UTF-8 text; lengths in um, angles in deg. A byte order mark, CRLF line ends and blank lines are accepted.
    cell
        Gives the joint columns and the limits.
    plan
        Accept a file without measurement too: columns other than the joints' may be missing, in any order.

    Returns
    -------
    Sweeps
        In um and rad; `rows` are lines of the file, the header being line 1.

    Raises
    ------
    InputError
        If anything in the file is not as documented; the message names the line and the column.
    """
    path = Path(path)
    records, lines = read_records(path)
    if not records:
        raise InputError(f"{path}: the file holds no text, expected a header and sweeps")
    header = records.pop(0)
    if len(header) == 1 and len(re.split("[;\t]", header[0])) > 1:
        raise located(path, "expected fields separated by commas", row=lines[0])
    check_names(header, cell, path, plan=plan, row=lines[0])
    required = list(required_columns(cell))
    if not plan and header[: len(required)] != required:
        place = next(i for i, name in enumerate(required) if header[i] != name)
        raise located(path, f"expected the column {required[place]}, found {header[place]}", row=lines[0])
    rows = np.array(lines[1:], dtype=np.int64)
    counts = np.array([len(record) for record in records])
    if (counts != len(header)).any():
        first = int(np.argmax(counts != len(header)))
        raise located(path, f"expected {len(header)} fields, found {counts[first]}", row=int(rows[first]))

    table: dict[str, Column] = {}
    for name, cells in zip(header, zip(*records, strict=True), strict=False):
        if name in TEXTS:
            # A text too long for its column is refused later; cut here, it does not widen every row of the array.
            table[name] = np.array([text[:1001] for text in cells], dtype=np.str_)
        elif name == "temperature_c":
            known = np.array([text != "" for text in cells])
            table[name] = np.where(known, column_numbers([text or "0" for text in cells], rows, path, name), np.nan)
        else:
            table[name] = column_numbers(cells, rows, path, name)
    return from_columns(table, cell, str(path), rows, plan=plan)


def write_csv(path: str | Path, sweeps: Sweeps, cell: Cell) -> None:
    """Write sweeps to a CSV file, whole or not at all.

    Parameters
    ----------
    path
        Replaced if it exists.
    sweeps
        Measured or a plan; a plan's file has no columns ``dl_um``, ``sigma_um``.

    Raises
    ------
    InputError
        If the file cannot be written, or the sweeps break a rule that a reader holds them to.
    """
    path = Path(path)
    table = to_columns(sweeps, cell, path)
    columns = [formatted(values) if values.dtype.kind == "f" else values.tolist() for values in table.values()]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*columns, strict=True))
    write_text(path, text.getvalue())


def read_records(path: Path) -> tuple[list[list[str]], list[int]]:
    """The fields of every line of a CSV file that is not blank, and its number."""
    text = read_text(path)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    records, lines = [], []
    try:
        for record in reader:
            if len(record) > 1 or (record and record[0].strip()):
                records.append(record)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise located(path, f"not a line of CSV ({error})", row=max(reader.line_num, 1)) from error
    # Of 0 and 1 nothing can be cut off; any other last field may be a part of what was written.
    if len(records) > 1 and records[0][-1] != "signed":
        require_line_end(path, text)
    return records, lines


def column_numbers(cells: Sequence[str], rows: NDArray[np.int64], path: Path, name: str) -> NDArray[np.float64]:
    """The numbers of a column; `InputError` that names line and column if one is none."""
    if not _NUMBER_CHARACTERS.issuperset("".join(cells)) or "" in cells:
        _refuse(cells, rows, path, name)
    try:
        return np.array(list(map(float, cells)))
    except ValueError:
        _refuse(cells, rows, path, name)
        raise


def _refuse(cells: Sequence[str], rows: NDArray[np.int64], path: Path, name: str) -> None:
    """Name the first cell that is not a number; looked for only when there is one."""
    for cell, row in zip(cells, rows.tolist(), strict=True):
        if not _NUMBER.fullmatch(cell):
            found = f"found {shown(cell)}" if cell else "found nothing"
            raise located(path, f"expected a number, {found}", row=row, column=name)


def formatted(values: NDArray[np.float64]) -> list[str]:
    """Numbers as they stand in a file, NaN as nothing."""
    # Adding zero turns -0 into 0.
    return ["" if value != value else f"{value:.{_DIGITS}g}" for value in (values + 0.0).tolist()]
