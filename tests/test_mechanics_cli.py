"""Commands on a machine with error motions: what they take into account, what they hand on, what they say."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machine_errors import mechanics_task_errors

from fpcal_bayes.analysis.motions import motion_curves
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import CONTENT_HASH, write_json
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.compare import parse_models
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import read_csv, write_csv
from fpcal_bayes.model.mechanics.errors import known_task_errors
from fpcal_bayes.motion.compensation import compensated
from fpcal_bayes.motion.controller import Controller
from fpcal_bayes.motion.tasks import task_path

CELL = load_cell()


def run(*arguments: object) -> None:
    assert main([*map(str, arguments), "--mechanics", "stated", "--quiet"]) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("machine")
    run("simulate", "-o", made / "sweeps.csv", "--seed", 4)
    run("identify", made / "sweeps.csv", "--json", made / "estimate.json")
    return made


@pytest.fixture(scope="module")
def mid(folder: Path) -> Path:
    """An estimate from sweeps with a midpoint each."""
    run("simulate", "-o", folder / "mid.csv", "--seed", 4, "--protocol", "paper-mid")
    run("identify", folder / "mid.csv", "--json", folder / "mid.json")
    return folder / "mid.json"


@pytest.fixture(scope="module")
def found(folder):
    return identify(CELL, read_csv(folder / "sweeps.csv", CELL))


def test_mechanics_are_stated_unless_asked_otherwise():
    program = "from fpcal_bayes.cli.main import make_parser; print(make_parser().parse_args(['doctor', 'x']).mechanics)"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "stated"
    assert load_cell().mechanics is not None
    assert load_cell(mechanics="none").mechanics is None
    assert load_cell().sha256 == load_cell(mechanics="none").sha256


def test_an_estimate_with_fewer_orders_is_read(folder, tmp_path):
    content = json.loads((folder / "estimate.json").read_text())
    whole, stated = read_estimate(folder / "estimate.json", CELL), content["mechanics"]
    kept = [i for i, name in enumerate(stated["names"]) if " of q1 [" not in name or int(name[-2]) < 6]
    for key in ("names", "mean", "factor"):
        stated[key] = [stated[key][i] for i in kept]
    del content[CONTENT_HASH]
    write_json(tmp_path / "older.json", content)
    older = read_estimate(tmp_path / "older.json", CELL)
    assert older.mechanics.names == whole.mechanics.names
    left_out = [i for i in range(len(whole.mechanics.names)) if i not in kept]
    expected = whole.mechanics.factor.copy()
    expected[left_out] = 0.0
    np.testing.assert_array_equal(older.mechanics.factor, expected)
    assert len(left_out) == 9
    run("task-error", tmp_path / "older.json", "--task", "circle")


def test_a_perfect_mechanism_does_not_fit_a_machine(folder, capsys):
    assert main(["identify", str(folder / "sweeps.csv"), "--mechanics", "none"]) == 0
    assert "poor fit" in capsys.readouterr().err


def test_an_estimate_hands_on_its_mechanics(folder):
    path = folder / "estimate.json"
    assert path.stat().st_size <= 500_000
    content = json.loads(path.read_text())
    mechanics = content["mechanics"]
    n = len(mechanics["names"])
    assert len(mechanics["mean"]) == len(mechanics["factor"]) == n
    assert mechanics["names"][:21] == list(content["parameters"])
    assert content["trust"]["usable"]
    assert "draws" not in content
    # Another statement of sizes is another machine.
    joint = replace(CELL.mechanics.joints[0], straightness_nm=31.0)
    other = replace(CELL.mechanics, joints=(joint, *CELL.mechanics.joints[1:]))
    with pytest.raises(InputError, match="other sizes"):
        read_estimate(path, replace(CELL, mechanics=other))
    assert read_estimate(path, CELL.ideal).mechanics is None


@pytest.mark.parametrize("name", ["circle", "tilt-z"])
def test_what_is_handed_on_predicts_as_the_fit_does(folder, found, name):
    estimate = read_estimate(folder / "estimate.json", CELL)
    task = task_path(CELL, estimate.vector(), name, n_points=31).driven()
    whole = mechanics_task_errors(found.machine, task)
    made, _, parts = known_task_errors(estimate, task.start, task.q)
    assert np.median(np.ptp(made.total, axis=1)) == pytest.approx(np.median(np.ptp(whole.total, axis=1)), rel=0.1)
    np.testing.assert_allclose(made.total.std(axis=0)[1:], whole.total.std(axis=0)[1:], rtol=0.3)
    np.testing.assert_allclose(np.sum(list(parts.values()), axis=0), made.total, atol=1e-9)


def test_task_errors_name_the_repeatable_part_and_the_return(folder):
    run("task-error", folder / "estimate.json", "--tolerance-nm", 50, "--json", folder / "te.json", "--task", "circle")
    circle = json.loads((folder / "te.json").read_text())["tasks"]["circle"]
    assert circle["points"] == 31
    assert 0 < circle["return_nm"]["median"] < circle["repeatable_nm"]["median"]
    assert circle["peak_to_peak_nm"]["low"] < circle["repeatable_nm"]["median"] < circle["peak_to_peak_nm"]["high"]


def test_a_budget_has_lines_by_term(folder):
    run("task-error", folder / "estimate.json", "--json", folder / "b.json", "--task", "circle", "--budget")
    budget = json.loads((folder / "b.json").read_text())["tasks"]["circle"]["budget"]
    names = [line["input"] for line in budget["inputs"]]
    assert any(" of q" in name for name in names)
    assert "robot angles" in names
    assert budget["combined_nm"] > 20


def test_joints_carry_the_sd_of_the_machine(folder):
    run("control", "--estimate", folder / "estimate.json", "--task", "circle", "-o", folder / "joints.csv")
    with (folder / "joints.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 31
    assert max(float(row["predicted_sd_nm"]) for row in rows) > 20


def test_observe_and_doctor_name_terms_and_leave_sigma_alone(folder):
    run("observe", folder / "sweeps.csv", "--json", folder / "observe.json")
    mechanics = json.loads((folder / "observe.json").read_text())["mechanics"]
    assert {"stage, along the beam", "return", "noise"} <= set(mechanics["scales"])
    assert any(test["term"].startswith("direction of approach") for test in mechanics["tests"])
    run("doctor", folder / "sweeps.csv", "--json", folder / "doctor.json")
    kinds = {finding["kind"] for finding in json.loads((folder / "doctor.json").read_text())["findings"]}
    assert "sigma" not in kinds


def test_a_track_knows_the_error_motions(folder):
    run("track", folder / "sweeps.csv", "--json", folder / "track.json", "--estimate", folder / "now.json")
    trust = json.loads((folder / "track.json").read_text())["trust"]
    assert "mechanics-left-out" not in {reason["kind"] for reason in trust["reasons"]}
    assert (folder / "now.json").stat().st_size <= 500_000
    assert read_estimate(folder / "now.json", CELL).mechanics is not None
    tasks = []
    for name in ("estimate", "now"):
        run("task-error", folder / f"{name}.json", "--json", folder / "te.json", "--task", "circle")
        tasks.append(json.loads((folder / "te.json").read_text())["tasks"]["circle"]["peak_to_peak_nm"])
    # The track takes the sizes at their typical values, an identification draws them.
    assert tasks[1]["median"] == pytest.approx(tasks[0]["median"], rel=0.35)


def test_joints_make_up_for_the_known_motions_where_that_gains(folder, mid):
    found = {}
    for options in ((), ("--no-compensation",)):
        run("control", "--estimate", mid, "--task", "tilt-x", "-o", folder / "j.csv", *options,
            "--json", folder / "c.json")  # fmt: skip
        found[options] = json.loads((folder / "c.json").read_text())["tasks"]["tilt-x"]
    better, plain = found[()], found[("--no-compensation",)]
    assert better["compensation"]["applied"]
    assert not plain["compensation"]["applied"]
    assert better["compensation"]["median_without_nm"] == pytest.approx(plain["peak_to_peak_nm"]["median"])
    assert better["peak_to_peak_nm"]["median"] < 0.9 * plain["peak_to_peak_nm"]["median"]
    assert max(better["sd_nm"]) < max(plain["sd_nm"])


def test_curves_of_the_motions_stay_within_what_is_known(found):
    curves = motion_curves(found.estimate)
    assert len(curves) == len(found.machine.terms.motions)
    for curve in curves:
        assert (curve.low <= curve.middle).all()
        assert (curve.middle <= curve.high).all()
    assert curves[0].shown > 0.3


def test_models_without_a_term():
    models = parse_models("mechanics=stated,mechanics=no-reversal,mechanics=none", CELL)
    assert [model.cell(CELL).mechanics is None for model in models] == [False, False, True]
    assert models[1].cell(CELL).mechanics.joints[0].reversal == 0.0
    assert models[1].words == "the axis path without reversal"
    with pytest.raises(InputError, match="the cell states no mechanics"):
        parse_models("mechanics=none,mechanics=stated", CELL.ideal)


def test_sampling_agrees_with_the_mixture_of_scales(found):
    posterior = sample(found, draws=200, seed=2, max_steps=20)
    assert posterior.acceptance > 0.5
    scores = posterior.points[..., : found.problem.n_free].reshape(-1, found.problem.n_free)
    mean, covariance = found.machine.moments()
    sd = np.sqrt(np.diag(covariance))
    assert np.abs((scores.mean(axis=0) - mean) / sd).max() < 0.5
    assert np.median(scores.std(axis=0) / sd) == pytest.approx(1.0, abs=0.1)
    with pytest.raises(InputError, match="--mechanics none"):
        sample(found, likelihood="student")


def test_times_and_approach_are_read_and_written(tmp_path, folder):
    sweeps = read_csv(folder / "sweeps.csv", CELL)
    n = len(sweeps)
    full = replace(
        sweeps,
        t_start_h=np.arange(n) / 60.0,
        t_end_h=(np.arange(n) + 0.5) / 60.0,
        approach=np.full(n, "+-00+0"),
        shot=np.array([f"s{i}" for i in range(n)]),
    )
    write_csv(tmp_path / "full.csv", full, CELL)
    back = read_csv(tmp_path / "full.csv", CELL)
    np.testing.assert_allclose(back.t_end_h, full.t_end_h)
    assert back.approach_signs()[0].tolist() == [1.0, -1.0, 0.0, 0.0, 1.0, 0.0]
    for change, word in (
        ({"approach": np.full(n, "+-")}, "one of +-0"),
        ({"t_end_h": full.t_start_h - 1.0}, "at or after"),
        ({"t_end_h": np.full(n, np.nan)}, "together"),
    ):
        with pytest.raises(InputError, match=word.replace("+", r"\+")):
            write_csv(tmp_path / "bad.csv", replace(full, **change), CELL)


def test_a_controller_makes_up_by_the_way_that_it_comes(mid):
    estimate = read_estimate(mid, CELL)
    task = task_path(CELL, estimate.vector(), "tilt-x", n_points=9)
    better = compensated(estimate, task)
    assert better.added is not None
    there = Controller(estimate, task.start)
    np.testing.assert_allclose(there.joints(task.poses).q, better.q, atol=1e-9)
    np.testing.assert_allclose(
        Controller(estimate, task.start, compensate=False).joints(task.poses).q, task.q, atol=1e-9
    )
    # It stands where it was sent, as far as the geometry tells, however often it moves.
    for pose in task.poses[:3]:
        there.move_to(pose)
        np.testing.assert_allclose(there.pose, pose, atol=1e-6)
    # From the other side the joint along the beam makes up for its reversal the other way.
    one, other = (Controller(estimate, task.q[i]).joints(task.poses[4]).q for i in (0, -1))
    moved = np.flatnonzero(one != other)
    assert moved.tolist() == [1]
    assert 0 < abs(one[1] - other[1]) < 0.2
