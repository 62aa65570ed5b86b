"""Recorded paths in files, and joint paths read for the rig."""

from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.joint_paths import read_joint_path
from fpcal_bayes.io.traces import path_columns, read_path_trace, write_path_trace
from fpcal_bayes.io.truth import read_truth, write_truth
from fpcal_bayes.measure.traces import PathTrace
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cell.cell import Cell

PARTS = np.repeat([True, False, True], [10, 20, 9])


def recording() -> PathTrace:
    random = np.random.default_rng(0)
    n = len(PARTS)
    return PathTrace(np.arange(n) / 7.0, 0.01 * random.standard_normal((n, 6)), random.random(n), PARTS)


def test_written_paths_read_back(femto: Cell, tmp_path: Path) -> None:
    trace = recording()
    write_path_trace(tmp_path / "p.csv", trace, femto)
    read = read_path_trace(tmp_path / "p.csv", femto)
    np.testing.assert_allclose(read.q, trace.q, rtol=1e-12)
    np.testing.assert_allclose(read.irradiance, trace.irradiance, rtol=1e-12)
    np.testing.assert_array_equal(read.reference, PARTS)
    assert (read.before, read.path, read.after) == (slice(0, 10), slice(10, 30), slice(30, 39))


def edited(lines: list[str], row: int, old: str, new: str) -> list[str]:
    return [line.replace(old, new) if i == row - 1 else line for i, line in enumerate(lines)]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda x: ["t_s,irradiance_v", *x[1:]], "row 1: expected the header part,t_s,q1_um"),
        (lambda x: x[:1], "part path, expected 8 or more|before the path"),
        (lambda x: [x[0], *x[11:]], "row 2, column part: expected a reference scan before the path"),
        (lambda x: [x[0], *x[5:]], "6 samples of the reference, expected 8"),
        (lambda x: x[:11], "no samples of part path"),
        (lambda x: edited(x, 15, "path", "reference"), "column part: expected the path in one piece"),
        (lambda x: edited(x, 4, "reference", "way"), "row 4, column part: expected reference or path, found 'way'"),
        (lambda x: [*x[:5], x[5] + ",1", *x[6:]], "row 6: expected 9 fields, found 10"),
        (lambda x: [*x[:5], x[5].rpartition(",")[0] + ",nan", *x[6:]], "row 6, column irradiance_v: expected a number"),
        (lambda x: [*x[:5], x[5].rpartition(",")[0] + ",1e999", *x[6:]], "row 6, column irradiance_v: expected a fin"),
        (lambda x: [*x[:5], x[6], x[5], *x[7:]], "row 7, column t_s: expected a later time"),
        (lambda x: [*x[:5], "reference,0.5,999,0,0,0,0,0,1", *x[6:]], "row 6, column q1_um: 999 um is outside"),
    ],
)
def test_bad_files_are_refused(femto: Cell, tmp_path: Path, edit, message: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "p.csv"
    write_path_trace(path, recording(), femto)
    path.write_text("\n".join(edit(path.read_text().splitlines())) + "\n")
    with pytest.raises(InputError, match=message):
        read_path_trace(path, femto)


def test_joint_paths_of_the_controller_are_read(femto: Cell, tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    header = ",".join([*femto.joint_columns, "status", "predicted_sd_nm"])
    path.write_text(f"{header}\n1,2,3,1,2,90,ok,0.5\n0,0,0,0,0,0,ok,0.1\n")
    q = read_joint_path(path, femto)
    np.testing.assert_allclose(q[0], [1, 2, 3, np.radians(1), np.radians(2), np.pi / 2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2\n", "row 1: expected the header q1_um"),
        ("{h},status\n1,2,3,1,2,90,ok\n,,,,,,q4 beyond its limit\n", "row 3, column status: expected points"),
        ("{h}\n1,2,3,1,2,90\n", "1 points, expected a path of two or more"),
        ("{h}\n1,2,3,1,2,90\n1,2,3,1,2\n", "row 3: expected 6 fields, found 5"),
        ("{h}\n1,2,3,1,2,90\n1,2,3,1,2,1e999\n", "row 3, column q6_deg: expected a finite number"),
        ("{h}\n1,2,3,1,2,90\n1,2,3,1,2,x\n", "row 3, column q6_deg: expected a number, found 'x'"),
        ("{h}\n1,2,3,1,2,90\n1,2,3,9,2,0\n", "row 3, column q4_deg: 9 deg is outside the limits"),
    ],
)
def test_bad_joint_paths_are_refused(femto: Cell, tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "joints.csv"
    path.write_text(text.replace("{h}", ",".join(femto.joint_columns)))
    with pytest.raises(InputError, match=message):
        read_joint_path(path, femto)


def test_written_truths_read_back(femto: Cell, tmp_path: Path) -> None:
    truth = paper_truth(femto)
    write_truth(tmp_path / "truth.toml", truth)
    read = read_truth(tmp_path / "truth.toml", femto)
    np.testing.assert_array_equal(read.times_h, truth.times_h)
    np.testing.assert_array_equal(read.values, truth.values)


def test_columns(femto: Cell) -> None:
    assert path_columns(femto)[:3] == ("part", "t_s", "q1_um")
