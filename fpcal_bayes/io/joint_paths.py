"""Joint paths in files: CSV, and MAT for controllers that are driven from MATLAB; a user's path of poses."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, largest, located
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import read_records, write_table
from fpcal_bayes.io.recordings_mat import write_mat
from fpcal_bayes.model.cell.cell import Cell, check_joints

#: Columns that may stand beside the joints'.
_OTHERS = ("status", "predicted_sd_nm")
PATH_COLUMNS = ("x_um", "y_um", "z_um", "rx_deg", "ry_deg", "rz_deg")


def read_joint_path(path: str | Path, cell: Cell) -> Floats:
    """Joint vectors (n, n_joints) in um and rad from a CSV with the columns ``q1_um`` .. ``q6_deg``, each status ok."""
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


def write_joints(
    path: str | Path, cell: Cell, q: Floats, status: NDArray[np.str_], predicted_sd: Floats, *, task: str
) -> None:
    """Write a joint path (n_points, n_joints), empty or NaN where not ok, as CSV or MATLAB; `predicted_sd` is in um."""
    path = Path(path)
    require_suffix(path, ".csv", ".mat")
    shown = np.where((status == "ok")[:, None], q, np.nan) / cell.joint_scales
    joints, sd_nm = dict(zip(cell.joint_columns, shown.T, strict=True)), 1e3 * predicted_sd
    if path.suffix.lower() == ".csv":
        write_table(path, {**joints, "status": status, "predicted_sd_nm": sd_nm})
        return
    write_mat(path, {**joints, "q": shown, "status": status, "predicted_sd_nm": sd_nm, "task": task})


def read_path(path: str | Path) -> Floats:
    """Moves (n, 6) away from the aligned pose in um and rad, from a CSV with the columns `PATH_COLUMNS`, n > 1."""
    path = Path(path)
    records = read_records(path, f"the header {','.join(PATH_COLUMNS)}")
    records.require_header(PATH_COLUMNS)
    columns, expected = records.columns().items(), "expected a finite number"
    numbers = [records.numbers(name, texts, finite=True, expected=expected) for name, texts in columns]
    shown: Floats = np.column_stack(numbers)
    n = len(shown)
    if n < 2:
        raise InputError(f"{path}: {n} row{'' if n == 1 else 's'}, expected a path of two or more")
    for row, place in np.argwhere(np.abs(shown) > [largest(name) for name in PATH_COLUMNS]):
        name = PATH_COLUMNS[place]
        raise located(path, f"expected at most {largest(name):g}", row=int(records.rows[row]), column=name)
    shown *= np.repeat([1.0, np.pi / 180.0], 3)
    return shown
