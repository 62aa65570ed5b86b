"""``fpcal control`` and ``fpcal task-error``."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import DATA
from test_cli import error_lines
from test_task_prediction import write_posterior

from fpcal_bayes.cli.main import main
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import TASKS

CASE_A = DATA / "case_a.csv"
HEADER = "x_um,y_um,z_um,rx_deg,ry_deg,rz_deg\n"


@pytest.fixture(scope="module")
def estimate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("estimate") / "estimate.json"
    assert main(["identify", str(CASE_A), "--json", str(file), "--quiet"]) == 0
    return file


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, estimate: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """Every test starts in a folder that holds the estimate only."""
    monkeypatch.chdir(tmp_path)
    Path("e.json").write_bytes(estimate.read_bytes())
    capsys.readouterr()
    return tmp_path


def run(*arguments: object, code: int = 0) -> None:
    assert main(list(map(str, arguments))) == code


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    run(*arguments, code=2)
    lines = error_lines(capsys.readouterr().err)
    assert len(lines) == 1
    return lines[0]


class TestControl:
    def test_an_estimate_past_its_horizon_is_named(self, capsys: pytest.CaptureFixture[str]) -> None:
        content = json.loads(Path("e.json").read_text())
        del content["content_sha256"]
        Path("e.json").write_text(json.dumps(content | {"time_h": 24.0, "valid_until_h": 31.5}))
        common = (
            "control",
            "--estimate",
            "e.json",
            "--task",
            "circle",
            "--points",
            5,
            "-o",
            "j.csv",
            "--json",
            "j.json",
        )
        run(*common, "--now", 31.4)
        before = json.loads(Path("j.json").read_text())["warnings"]
        assert not any("was valid until" in text for text in before)
        capsys.readouterr()
        run(*common, "--now", 33)
        told = [
            line for line in capsys.readouterr().err.splitlines() if "was valid until 31.50 h, which has passed" in line
        ]
        assert len(told) == 1
        assert len(json.loads(Path("j.json").read_text())["warnings"]) == len(before) + 1
        assert "--now" in refusal(capsys, *common, "--now", "soon")

    def test_joint_file(self, capsys: pytest.CaptureFixture[str]) -> None:
        run("control", "--estimate", "e.json", "--task", "circle", "--radius-um", 50, "-o", "j.csv", "--json", "j.json")
        lines = Path("j.csv").read_text().splitlines()
        assert lines[0] == "q1_um,q2_um,q3_um,q4_deg,q5_deg,q6_deg,status,predicted_sd_nm"
        assert len(lines) == 62
        fields = [line.split(",") for line in lines[1:]]
        assert all(field[6] == "ok" for field in fields)
        travel = np.array([[float(field[0]), float(field[2])] for field in fields])
        assert np.ptp(travel, axis=0) == pytest.approx([100.0, 100.0], rel=1e-3)
        written = json.loads(Path("j.json").read_text())
        assert (written["schema"], written["command"]) == ("fpcal/1", "control")
        task = written["tasks"]["circle"]
        assert task["worst_sd_nm"] == pytest.approx(max(float(field[7]) for field in fields), rel=1e-6)
        assert task["points_not_ok"] == 0
        assert set(task["status"]) == {"ok"}
        assert "parameters" in written
        assert "covariance" in written
        assert "circle" in capsys.readouterr().out

    def test_points_that_saturate_are_said(self, capsys: pytest.CaptureFixture[str]) -> None:
        run("control", "--estimate", "e.json", "--task", "line-z", "-o", "j.mat", "--quiet")
        out, err = capsys.readouterr()
        assert out == ""
        assert "fpcal: warning: task line-z: 1 of 61 points cannot be driven to; point 1: saturated: q1" in err

    def test_user_path(self) -> None:
        Path("p.csv").write_text(HEADER + "0,0,0,0,0,0\n5,0,0,0,0,0\n0,0,0,0,1,0\n")
        run("control", "--estimate", "e.json", "--task", "p.csv", "-o", "j.csv")
        assert len(Path("j.csv").read_text().splitlines()) == 4

    def test_posterior(self, femto: Cell) -> None:
        values = np.random.default_rng(0).normal(femto.free.nominal, 1e-3 * femto.free.prior_sd, (20, 21))
        write_posterior(Path("p.nc"), femto, values)
        run("control", "--estimate", "p.nc", "--task", "tilt-x", "-o", "j.csv", "--points", 5)
        assert len(Path("j.csv").read_text().splitlines()) == 6

    def test_bad_input(self, capsys: pytest.CaptureFixture[str]) -> None:
        common = ("control", "--estimate", "e.json")
        Path("one.csv").write_text(HEADER + "0,0,0,0,0,0\n")
        assert "one.csv: 1 row, expected a path of two" in refusal(capsys, *common, "--task", "one.csv", "-o", "j.csv")
        Path("far.csv").write_text(HEADER + "0,900,0,0,0,0\n0,901,0,0,0,0\n")
        far = refusal(capsys, *common, "--task", "far.csv", "-o", "j.csv")
        assert "no point can be driven to; point 1: saturated: q2" in far
        assert "unknown task 'square'" in refusal(capsys, *common, "--task", "square", "-o", "j.csv")
        assert "ends in .csv or .mat" in refusal(capsys, *common, "--task", "circle", "-o", "j.txt")
        assert "is an input" in refusal(capsys, *common, "--task", "far.csv", "-o", "far.csv")
        other = refusal(capsys, *common, "--opd", "perpendicular", "--task", "circle", "-o", "j.csv")
        assert "of another cell ('femto-st', opd 'axis'" in other
        five = ("--cell", DATA / "xy-theta.toml")
        assert "another cell" in refusal(capsys, *common, *five, "--task", "circle", "-o", "j.csv")
        assert not Path("j.csv").exists()


class TestTaskError:
    def test_all_tasks(self, capsys: pytest.CaptureFixture[str]) -> None:
        run("task-error", "e.json", "--tolerance-nm", 50, "--json", "t.json")
        out = capsys.readouterr().out
        written = json.loads(Path("t.json").read_text())
        assert written["command"] == "task-error"
        assert tuple(written["tasks"]) == TASKS
        for name, task in written["tasks"].items():
            assert name in out
            band = task["peak_to_peak_nm"]
            assert 0 < band["low"] < band["median"] < band["high"]
            assert 0 <= task["exceeds_probability"] < 0.5
            assert len(task["sd_nm"]) == len(task["band_nm"]["low"]) == task["points"] == 61
            assert (task["method"], task["draws"]) == ("draws", 500)
        assert written["tasks"]["circle"]["worst_sd_nm"] == pytest.approx(1.0, abs=0.1)
        assert written["tasks"]["tilt-x"]["worst_sd_nm"] == pytest.approx(31.5, rel=0.2)

    def test_without_draws_the_same_seed_gives_the_same_numbers(self) -> None:
        content = json.loads(Path("e.json").read_text())
        del content["draws"], content["content_sha256"]
        Path("e.json").write_text(json.dumps(content))
        for name, seed in (("a", 1), ("b", 1), ("c", 2)):
            run("task-error", "e.json", "--task", "circle", "--draws", 100, "--seed", seed, "--json", name)
        first, again, other = (json.loads(Path(name).read_text())["tasks"]["circle"] for name in "abc")
        assert first["method"] == "linear"
        assert first == again
        assert first["band_nm"] != other["band_nm"]

    def test_budget(self, capsys: pytest.CaptureFixture[str]) -> None:
        run("task-error", "e.json", "--task", "tilt-x", "--budget", "--json", "t.json")
        out = capsys.readouterr().out
        assert "robot angles" in out
        assert "correlation of " in out
        assert "combined standard uncertainty" in out
        budget = json.loads(Path("t.json").read_text())["tasks"]["tilt-x"]["budget"]
        assert len(budget["correlation"]) == len(budget["inputs"])

    def test_posterior(self, femto: Cell, capsys: pytest.CaptureFixture[str]) -> None:
        values = np.random.default_rng(0).normal(femto.free.nominal, 1e-3 * femto.free.prior_sd, (20, 21))
        write_posterior(Path("p.nc"), femto, values)
        run("task-error", "p.nc", "--task", "spin", "--estimate", "e.json", "--json", "t.json")
        assert json.loads(Path("t.json").read_text())["tasks"]["spin"]["method"] == "draws"
        capsys.readouterr()
        assert "another cell" in refusal(capsys, "task-error", "p.nc", "--opd", "perpendicular")
        assert "beside posterior draws" in refusal(capsys, "task-error", "e.json", "--estimate", "e.json")
