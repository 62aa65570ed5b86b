"""Joint files: CSV, and MAT as Octave reads it."""

import csv
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.io import loadmat
from task_fixtures import paper_values

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.joint_paths import write_joints
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import Task, task_path

OCTAVE = shutil.which("octave-cli")


@pytest.fixture
def task(femto: Cell) -> Task:
    """A line whose last point saturates."""
    return task_path(femto, CavityModel.of(femto).vector(paper_values(femto)), "line-x", n_points=7)


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(newline="") as handle:
        header, *rows = list(csv.reader(handle))
    return header, rows


def test_csv(task: Task, tmp_path: Path) -> None:
    sd = np.linspace(1e-3, 2e-3, 7)
    write_joints(tmp_path / "joints.csv", task.cell, task.q, task.status, sd, task=task.name)
    header, rows = read_csv(tmp_path / "joints.csv")
    assert header == ["q1_um", "q2_um", "q3_um", "q4_deg", "q5_deg", "q6_deg", "status", "predicted_sd_nm"]
    assert [row[6] for row in rows] == task.status.tolist()
    assert rows[-1][:6] == [""] * 6
    assert "saturated: q3" in rows[-1][6]
    found = np.array([[float(text) for text in row[:6]] for row in rows[:-1]])
    assert_allclose(found * task.cell.joint_scales, task.q[:-1], rtol=1e-12, atol=1e-12)
    assert_allclose([float(row[7]) for row in rows], 1e3 * sd, rtol=1e-12)


def test_mat_holds_what_the_csv_holds(task: Task, tmp_path: Path) -> None:
    sd = np.full(7, 1e-3)
    sd[2] = np.nan
    write_joints(tmp_path / "joints.csv", task.cell, task.q, task.status, sd, task=task.name)
    write_joints(tmp_path / "joints.mat", task.cell, task.q, task.status, sd, task=task.name)
    content = loadmat(tmp_path / "joints.mat")
    header, rows = read_csv(tmp_path / "joints.csv")
    for i, name in enumerate(header[:6]):
        expected = [float(row[i] or "nan") for row in rows]
        assert_allclose(content[name][:, 0], expected, rtol=1e-12, atol=1e-12)
        assert_allclose(content["q"][:, i], expected, rtol=1e-12, atol=1e-12)
    assert [str(cell[0]) for cell in content["status"][:, 0]] == task.status.tolist()
    assert_allclose(content["predicted_sd_nm"][:, 0], 1e3 * sd)
    assert content["task"][0] == "line-x"


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed (apt-get install octave)")
def test_octave_reads_the_mat_file(task: Task, tmp_path: Path) -> None:
    write_joints(tmp_path / "joints.mat", task.cell, task.q, task.status, np.full(7, 1e-3), task=task.name)
    script = (
        "load('joints.mat'); fprintf('%.17g\\n', q'); fprintf('%.17g\\n', q4_deg); "
        "fprintf('%d %s\\n', numel(status), status{1}); fprintf('%s\\n', task); disp(size(predicted_sd_nm))"
    )
    ran = subprocess.run(
        [str(OCTAVE), "--no-init-file", "--eval", script],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    lines = ran.stdout.split("\n")
    shown = np.where(task.ok[:, None], task.q, np.nan) / task.cell.joint_scales
    numbers = np.array([float(line) for line in lines[:49]])
    assert_allclose(numbers[:42].reshape(7, 6), shown, rtol=1e-15, atol=0)
    assert_allclose(numbers[42:], shown[:, 3], rtol=1e-15, atol=0)
    assert lines[49:51] == ["7 ok", "line-x"]
    assert lines[51].split() == ["7", "1"]


def test_other_suffixes_are_refused(task: Task, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"joints.txt: expected a file name that ends in .csv or .mat"):
        write_joints(tmp_path / "joints.txt", task.cell, task.q, task.status, np.zeros(7), task=task.name)
    with pytest.raises(InputError, match="does not exist"):
        write_joints(tmp_path / "none" / "joints.mat", task.cell, task.q, task.status, np.zeros(7), task=task.name)
