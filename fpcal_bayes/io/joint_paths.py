"""Joint paths in files: CSV, and MAT for controllers that are driven from MATLAB."""

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import replacing, write_text
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import column_numbers, read_records
from fpcal_bayes.model.cell.cell import Cell, check_joints

#: Columns that may stand beside the joints'.
_OTHERS = ("status", "predicted_sd_nm")


def read_joint_path(path: str | Path, cell: Cell) -> Floats:
    """Read joint vectors.

    Parameters
    ----------
    path
        CSV with the columns ``q1_um`` .. ``q6_deg`` and possibly ``status`` and ``predicted_sd_nm``, two lines or more.

    Returns
    -------
    ndarray
        Shape (n, n_joints), in um and rad.

    Raises
    ------
    InputError
        If the file is anything else, a joint leaves its limits, or the status of a line is not ``ok``: a path with a
        gap cannot be driven.
    """
    path = Path(path)
    records, lines = read_records(path)
    header, rows = (records[0] if records else []), np.array(lines[1:], dtype=np.int64)
    wanted = list(cell.joint_columns)
    if header[: len(wanted)] != wanted or not set(header[len(wanted) :]) <= set(_OTHERS):
        expected = f"expected the header {','.join(wanted)}, then any of {','.join(_OTHERS)}"
        raise located(path, expected, row=lines[0] if lines else 1)
    for record, row in zip(records[1:], rows.tolist(), strict=True):
        if len(record) != len(header):
            raise located(path, f"expected {len(header)} fields, found {len(record)}", row=row)
        if "status" in header and record[header.index("status")] != "ok":
            raise located(path, "expected points that can be driven to, with status ok", row=row, column="status")
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} points, expected a path of two or more")
    fields = list(zip(*records[1:], strict=True))
    columns = [column_numbers(cells, rows, path, name) for name, cells in zip(wanted, fields, strict=False)]
    q: Floats = np.column_stack(columns) * cell.joint_scales
    if not np.isfinite(q).all():
        row, column = np.argwhere(~np.isfinite(q))[0]
        raise located(path, "expected a finite number", row=int(rows[row]), column=wanted[column])
    check_joints(cell, q, path, rows.tolist(), wanted)
    return q


SUFFIXES = (".csv", ".mat")
#: Digits written: a picometre and a nanodegree survive.
_DIGITS = 13


def check_suffix(path: Path) -> None:
    """Raise `InputError` unless the name of a joint file says its format."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: expected a file name that ends in .csv or .mat")


def write_joints(
    path: str | Path, cell: Cell, q: Floats, status: NDArray[np.str_], predicted_sd: Floats, *, task: str
) -> None:
    """Write a joint path.

    Parameters
    ----------
    path
        ``.csv``: columns ``q1_um`` .. ``q6_deg``, ``status``, ``predicted_sd_nm``; joint values are left empty where
        the status is not ``ok``, so that nobody drives there. ``.mat``: variables of the same names, NaN there,
        ``q`` (n_points, n_joints) with all joints side by side, and ``task``.
    q
        Joint vectors in um and rad, shape (n_points, n_joints).
    status
        Of each point, shape (n_points,).
    predicted_sd
        Of the task error at each point, shape (n_points,), in um; NaN where there is none.
    task
        Name of the task.

    Raises
    ------
    InputError
        If the name ends in neither, or the file cannot be written.
    """
    path = Path(path)
    check_suffix(path)
    shown = np.where((status == "ok")[:, None], q, np.nan) / cell.joint_scales
    sd_nm = 1e3 * predicted_sd
    if path.suffix.lower() == ".mat":
        columns = {name: column[:, None] for name, column in zip(cell.joint_columns, shown.T, strict=True)}
        texts = np.empty((len(q), 1), dtype=object)
        texts[:, 0] = status.tolist()
        content = {**columns, "q": shown, "status": texts, "predicted_sd_nm": sd_nm[:, None], "task": task}
        with replacing(path) as temporary, temporary.open("wb") as handle:
            savemat(handle, content, oned_as="column")
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*cell.joint_columns, "status", "predicted_sd_nm"])
    for joints, state, sd in zip(shown.tolist(), status.tolist(), sd_nm.tolist(), strict=True):
        writer.writerow([*map(_number, joints), state, _number(sd)])
    write_text(path, text.getvalue())


def _number(value: float) -> str:
    # Adding zero turns -0 into 0.
    return "" if value != value else f"{value + 0.0:.{_DIGITS}g}"
