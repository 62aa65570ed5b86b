"""Joint paths in files: CSV, and MAT for controllers that are driven from MATLAB."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import replacing
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import read_records, write_table
from fpcal_bayes.model.cell.cell import Cell, check_joints

#: Columns that may stand beside the joints'.
_OTHERS = ("status", "predicted_sd_nm")


def read_joint_path(path: str | Path, cell: Cell) -> Floats:
    """Joint vectors (n, n_joints) in um and rad from a CSV with the columns ``q1_um`` .. ``q6_deg``.

    `InputError` if the status of a line is not ``ok``: a path with a gap cannot be driven.
    """
    path = Path(path)
    records = read_records(path)
    wanted = cell.joint_columns
    records.require_header(wanted, _OTHERS)
    columns = records.columns()
    for status, row in zip(columns.get("status", ()), records.rows.tolist(), strict=False):
        if status != "ok":
            raise located(path, "expected points that can be driven to, with status ok", row=row, column="status")
    if len(records.rows) < 2:
        raise InputError(f"{path}: {len(records.rows)} points, expected a path of two or more")
    q = np.column_stack([records.numbers(name, columns[name], finite=True) for name in wanted]) * cell.joint_scales
    check_joints(cell, q, path, records.rows.tolist(), wanted)
    return q


def check_suffix(path: Path) -> None:
    """Raise `InputError` unless the name of a joint file says its format."""
    if path.suffix.lower() not in (".csv", ".mat"):
        raise InputError(f"{path}: expected a file name that ends in .csv or .mat")


def write_joints(
    path: str | Path, cell: Cell, q: Floats, status: NDArray[np.str_], predicted_sd: Floats, *, task: str
) -> None:
    """Write a joint path (n_points, n_joints), whole or not at all, as ``.csv`` or ``.mat``.

    Joint values are left empty, or NaN, where the status is not ``ok``, so that nobody drives there; `predicted_sd` is
    in um, NaN where there is none.
    """
    path = Path(path)
    check_suffix(path)
    shown = np.where((status == "ok")[:, None], q, np.nan) / cell.joint_scales
    joints, sd_nm = dict(zip(cell.joint_columns, shown.T, strict=True)), 1e3 * predicted_sd
    if path.suffix.lower() == ".csv":
        write_table(path, {**joints, "status": status, "predicted_sd_nm": sd_nm})
        return
    texts = np.empty((len(q), 1), dtype=object)
    texts[:, 0] = status.tolist()
    columns = {name: column[:, None] for name, column in joints.items()}
    content = {**columns, "q": shown, "status": texts, "predicted_sd_nm": sd_nm[:, None], "task": task}
    with replacing(path) as temporary, temporary.open("wb") as handle:
        savemat(handle, content, oned_as="column")
