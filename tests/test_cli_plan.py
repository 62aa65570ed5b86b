"""``fpcal plan``."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import DATA
from test_cli import error_lines

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.model.cell.cell import Cell

CASE_A = DATA / "case_a.csv"
QUICK = ("--draws", 2, "--candidates", 30, "--mechanics", "none")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: object, code: int = 0) -> None:
    assert main(list(map(str, arguments))) == code


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    run("plan", *arguments, code=2)
    lines = [line for line in error_lines(capsys.readouterr().err) if "% done" not in line]
    assert len(lines) == 1
    return lines[0]


def test_plan_is_read_by_observe_and_simulate(femto: Cell, capsys: pytest.CaptureFixture[str]) -> None:
    run("plan", "--n", 3, *QUICK, "-o", "p.csv", "--rows", "r.csv", "--json", "p.json", "--figure", "p.svg")
    captured = capsys.readouterr()
    assert "plan / paper" in captured.out
    assert "undetermined" in captured.err
    plan = read_sweeps("p.csv", femto, plan=True, whole=True)
    header = Path("p.csv").read_text().splitlines()[0]
    assert "label,q1_start_um" in header
    assert header.endswith("q6_end_deg,readings")
    content = json.loads(Path("p.json").read_text())
    assert (content["schema"], content["command"], content["n_sweeps"]) == ("fpcal/1", "plan", 3)
    assert content["order"] == plan.label.tolist()
    assert sorted(content["most_useful_first"]) == sorted(content["order"])
    assert set(content["expected_sd_nm"]) == {
        *("before", "plan", "plan, where it was made", "single joints", "paper", "paper, midpoints")
    }
    assert content["seconds"]["plan"] < content["seconds"]["paper"]
    assert Path("p.svg").read_text().startswith("<?xml")
    run("observe", "p.csv", "--quiet")
    run("simulate", "--protocol", "p.csv", "-o", "s.csv")
    run("simulate", "--protocol", "r.csv", "-o", "m.csv")
    # What is promised is what the file gives: both are read at their middle too.
    for name in ("s.csv", "m.csv"):
        assert len(read_sweeps(name, femto)) == 6
    run("plan", "--n", 2, *QUICK, "--after", "m.csv", "-o", "next.csv")
    run("plan", "--n", 2, *QUICK, "--after", "p.csv", "-o", "later.csv", "--absolute", "--no-midpoints")
    assert len(read_sweeps("later.csv", femto, plan=True)) == 2


def test_same_seed_same_plan() -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        run("plan", "--n", 2, *QUICK, "--seed", seed, "-o", f"{name}.csv", "--quiet")
    first, again, other = (Path(f"{name}.csv").read_text() for name in "abc")
    assert first == again
    assert first != other


def test_reach(capsys: pytest.CaptureFixture[str]) -> None:
    run("plan", "--reach", "circle=200nm", *QUICK, "-o", "p.csv", "--json", "p.json")
    content = json.loads(Path("p.json").read_text())
    assert content["expected_sd_nm"]["plan"]["circle"] <= 200.0
    assert set(content["expected_sd_nm"]["plan"]) == {"circle"}
    line = refusal(capsys, "--reach", "circle=0.001nm", "--n", 3, *QUICK, "-o", "q.csv")
    assert "no plan of up to 3 sweeps reaches the target; the best has circle" in line
    assert not Path("q.csv").exists()


def test_reidentification(capsys: pytest.CaptureFixture[str]) -> None:
    run("identify", CASE_A, "--json", "e.json", "--quiet")
    run("plan", "--for", "extrinsic", "--estimate", "e.json", "--n", 3, *QUICK, "-o", "x.csv", "--json", "x.json")
    expected = json.loads(Path("x.json").read_text())["expected_sd_nm"]
    assert all(expected["plan"][task] < 0.5 * expected["before"][task] for task in ("circle", "spin"))
    run(
        "plan",
        "--for",
        "extrinsic",
        "--estimate",
        "e.json",
        "--hours",
        1,
        "--n",
        1,
        *QUICK,
        "-o",
        "y.csv",
        "--json",
        "y.json",
    )
    sooner = json.loads(Path("y.json").read_text())["expected_sd_nm"]["before"]
    assert sooner["circle"] < expected["before"]["circle"]


def test_a_mirror_that_no_task_can_turn(capsys: pytest.CaptureFixture[str]) -> None:
    """The mirror's x axis stands the other way round, beyond the limits of q5."""
    assert "aligned pose cannot be reached" in refusal(
        capsys, "--cell", DATA / "xy-theta.toml", "--n", 2, *QUICK, "-o", "p.csv"
    )


def test_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    plain = ("-o", "p.csv", *QUICK)
    assert "expected --n N or --reach TASK=NM" in refusal(capsys, *plain)
    assert "--reach 'circle': expected TASK=NM" in refusal(capsys, *plain, "--reach", "circle")
    assert "--reach 'circle=-1nm': expected a number above zero" in refusal(capsys, *plain, "--reach", "circle=-1nm")
    assert "unknown task 'square'" in refusal(capsys, *plain, "--n", 2, "--tasks", "square")
    assert "tolerance of an unknown task" in refusal(capsys, *plain, "--reach", "spin=5", "--tasks", "circle")
    assert "expected --estimate" in refusal(capsys, *plain, "--n", 2, "--for", "extrinsic")
    assert "beside --for extrinsic only" in refusal(capsys, *plain, "--n", 2, "--estimate", "e.json")
    assert "31 sweeps out of 30 candidates" in refusal(capsys, *plain, "--n", 31)
    assert "ends in .csv" in refusal(capsys, "-o", "p.txt", *QUICK, "--n", 2)
    assert "ends in .svg" in refusal(capsys, *plain, "--n", 2, "--figure", "p.pdf")
    Path("in.csv").write_bytes(CASE_A.read_bytes())
    assert "is an input" in refusal(capsys, "-o", "in.csv", *QUICK, "--n", 2, "--after", "in.csv")
    assert not Path("p.csv").exists()


def test_limits_are_kept(femto: Cell) -> None:
    run("plan", "--n", 3, *QUICK, "--max-tilt-deg", 2, "--single-joints", "-o", "p.csv", "--quiet")
    plan = read_sweeps("p.csv", femto, plan=True)
    tilts = np.degrees(np.hypot(*np.vstack([plan.q_start, plan.q_end])[:, 3:5].T))
    assert tilts.max() <= 2.01
    assert ((plan.q_start != plan.q_end).sum(axis=1) == 1).all()


def test_sweeps_that_reach_the_target_need_no_more(capsys: pytest.CaptureFixture[str]) -> None:
    run("plan", "--after", CASE_A, "--reach", "circle=20nm", *QUICK, "-o", "n.csv", "--json", "n.json")
    assert len(Path("n.csv").read_text().splitlines()) == 1
    content = json.loads(Path("n.json").read_text())
    assert (content["n_sweeps"], content["should_stop"]) == (0, True)
    assert content["expected_sd_nm"]["before"]["circle"] <= 20.0
    assert "no sweeps" in capsys.readouterr().out


def test_sweeps_that_miss_the_target_come_next_all_the_same(femto: Cell, capsys: pytest.CaptureFixture[str]) -> None:
    """The best that can be measured next; what is known already is not called undetermined."""
    asked = ("--after", CASE_A, "--reach", "circle=0.001nm", "--n", 2, *QUICK, "-o", "n.csv", "--json", "n.json")
    run("plan", *asked)
    warned = capsys.readouterr().err
    assert "no plan of up to 2 sweeps reaches the target; the best has circle" in warned
    assert "undetermined" not in warned
    content = json.loads(Path("n.json").read_text())
    assert (content["n_sweeps"], content["should_stop"]) == (2, False)
    expected = content["expected_sd_nm"]
    assert expected["plan"]["circle"] <= expected["single joints"]["circle"]
    assert len(read_sweeps("n.csv", femto, plan=True, whole=True)) == 2


def test_the_plan_is_no_worse_than_its_single_joints() -> None:
    """It is chosen on the draws planned for, many enough to stand for those it is judged on."""
    for seed in range(3):
        run("plan", "--n", 4, *QUICK, "--draws", 64, "--seed", seed, "-o", "p.csv", "--json", "p.json", "--quiet")
        expected = json.loads(Path("p.json").read_text())["expected_sd_nm"]
        worst = {
            name: max(expected[name][task] / sd for task, sd in expected["paper"].items())
            for name in ("plan", "single joints")
        }
        assert worst["plan"] <= 1.02 * worst["single joints"]


def test_as_many_sweeps_as_time_allows_and_the_frontier(femto: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fpcal_bayes.infer.design.plan._NUMBERS", (3, 4, 5))
    monkeypatch.setattr("fpcal_bayes.cli.plan._MOST_FRONTIER", 6)
    one_at_a_time = ("--no-coordinated", "--readings", 0, "-o", "p.csv", "--json", "p.json")
    run("plan", "--minutes", 1.5, "--n", 5, *QUICK, *one_at_a_time, "--frontier", "f.svg", "--quiet")
    content = json.loads(Path("p.json").read_text())
    plan = read_sweeps("p.csv", femto, plan=True, whole=True)
    assert 1 <= len(plan) <= 5
    assert content["seconds"]["plan"] <= 90.0
    assert ((plan.q_start != plan.q_end).sum(axis=1) == 1).all()
    assert Path("p.csv").read_text().splitlines()[1].endswith(",0")
    numbers = [point["n_sweeps"] for point in content["frontier"]["plans"]]
    assert content["frontier"]["knee"] in numbers[1:-1]
    assert Path("f.svg").read_text().startswith("<?xml")
