"""Joint paths that the rig drives, from a CSV as ``fpcal control`` writes it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError, located
from fpcal_bayes.measure.sweep_csv import column_numbers, read_records
from fpcal_bayes.model.cell import Cell, check_joints

Floats = NDArray[np.float64]

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
