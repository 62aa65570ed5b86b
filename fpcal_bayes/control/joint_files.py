"""Joint paths in files: CSV, and MAT for controllers that are driven from MATLAB."""

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.control.tasks import Task
from fpcal_bayes.errors import InputError
from fpcal_bayes.files import replacing, write_text

Floats = NDArray[np.float64]

SUFFIXES = (".csv", ".mat")
#: Digits written: a picometre and a nanodegree survive.
_DIGITS = 13


def check_suffix(path: Path) -> None:
    """Raise `InputError` unless the name of a joint file says its format."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: expected a file name that ends in .csv or .mat")


def write_joints(path: str | Path, task: Task, predicted_sd: Floats) -> None:
    """Write the joint path of a task.

    Parameters
    ----------
    path
        ``.csv``: columns ``q1_um`` .. ``q6_deg``, ``status``, ``predicted_sd_nm``; joint values are left empty where
        the status is not ``ok``, so that nobody drives there. ``.mat``: variables of the same names, NaN there,
        ``q`` (n_points, n_joints) with all joints side by side, and ``task``.
    task
        The path.
    predicted_sd
        Of the task error at each point, shape (n_points,), in um; NaN where there is none.

    Raises
    ------
    InputError
        If the name ends in neither, or the file cannot be written.
    """
    path = Path(path)
    check_suffix(path)
    shown = np.where(task.ok[:, None], task.q, np.nan) / task.cell.joint_scales
    if path.suffix.lower() == ".mat":
        _write_mat(path, task, shown, 1e3 * predicted_sd)
    else:
        _write_csv(path, task, shown, 1e3 * predicted_sd)


def _write_csv(path: Path, task: Task, shown: Floats, sd_nm: Floats) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*task.cell.joint_columns, "status", "predicted_sd_nm"])
    for joints, status, sd in zip(shown.tolist(), task.status.tolist(), sd_nm.tolist(), strict=True):
        writer.writerow([*map(_number, joints), status, _number(sd)])
    write_text(path, text.getvalue())


def _write_mat(path: Path, task: Task, shown: Floats, sd_nm: Floats) -> None:
    from scipy.io import savemat

    columns = {name: column[:, None] for name, column in zip(task.cell.joint_columns, shown.T, strict=True)}
    status = np.empty((len(task), 1), dtype=object)
    status[:, 0] = task.status.tolist()
    content = {
        **columns,
        "q": shown,
        "status": status,
        "predicted_sd_nm": sd_nm[:, None],
        "task": task.name,
    }
    with replacing(path) as temporary, temporary.open("wb") as handle:
        savemat(handle, content, oned_as="column")


def _number(value: float) -> str:
    # Adding zero turns -0 into 0.
    return "" if value != value else f"{value + 0.0:.{_DIGITS}g}"
