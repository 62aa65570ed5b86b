"""A robot that only its TOML file describes, taken through the whole workflow by the commands."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from path_length import path_length

from fpcal_bayes.analysis.campaign import gather
from fpcal_bayes.cli.main import main
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import read_csv, write_csv
from fpcal_bayes.io.truth import read_truth
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.report.campaign.words import verdict

DATA = Path(__file__).parent / "data"
FILE = DATA / "xyz-theta-tilts.toml"
CELL = load_cell(FILE, mechanics="none")


def fpcal(command: str, *arguments: object) -> None:
    assert main([command, "--cell", str(FILE), "--quiet", *map(str, arguments)]) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Simulated sweeps of two sessions, and what the commands make of them."""
    folder = tmp_path_factory.mktemp("robot")
    day0 = read_csv(DATA / "xyz-theta-tilts-plan.csv", CELL, plan=True)
    few = day0.take(np.arange(3, 40, 4))
    few.session[:], few.time_h[:] = "day1", 24.0
    write_csv(folder / "plan.csv", join([day0, few]), CELL)
    truth = DATA / "xyz-theta-tilts-truth.toml"
    fpcal("simulate", "--protocol", folder / "plan.csv", "--truth", truth, "--seed", 1, "-o", folder / "sweeps.csv")
    fpcal("identify", folder / "sweeps.csv", "--json", folder / "day0.json")
    return folder


def test_a_plan_says_what_it_will_tell(folder):
    fpcal("observe", DATA / "xyz-theta-tilts-plan.csv", "--json", folder / "observe.json")
    found = json.loads((folder / "observe.json").read_text())["observability"]
    # The turn of the last joint, and the fibre along its axis, leave no trace in changes of length.
    assert (found["rank"], found["n_parameters"]) == (15, 17)
    assert {gauge["parameters"][0] for gauge in found["gauges"]} == {"theta_6", "y_wf"}


def test_the_truth_is_found(folder):
    estimate = read_estimate(folder / "day0.json", CELL)
    truth = read_truth(DATA / "xyz-theta-tilts-truth.toml", CELL).at(0.0)
    known = [i for i, status in enumerate(estimate.status) if status == "identified"]
    pulls = (estimate.values - truth)[known] / estimate.sd[known]
    assert np.abs(pulls).max() < 4
    assert json.loads((folder / "day0.json").read_text())["fit"]["p_value"] > 1e-3


@pytest.mark.parametrize("task", ["circle", "tilt-x", "spin"])
def test_the_true_error_of_a_task_is_as_predicted(folder, task):
    fpcal("task-error", folder / "day0.json", "--task", task, "--json", folder / "task.json")
    predicted = json.loads((folder / "task.json").read_text())["tasks"][task]
    estimate = read_estimate(folder / "day0.json", CELL)
    truth = read_truth(DATA / "xyz-theta-tilts-truth.toml", CELL)
    vector = CELL.parameters.nominal.copy()
    vector[truth.parameters.slots] = truth.at(0.0)
    path = find_task(CELL, estimate.vector(), task, n_points=25).driven()
    # By plain 4x4 products, which share no code with the kernels.
    lengths = np.array([path_length(CELL, vector, q) for q in path.q])
    expected = np.array([path_length(CELL, estimate.vector(), q) for q in path.q])
    peak_to_peak = 1e3 * np.ptp(lengths - expected)
    assert peak_to_peak < 2 * predicted["peak_to_peak_nm"]["high"]


def test_joints_of_a_circle(folder):
    fpcal("control", "--estimate", folder / "day0.json", "--task", "circle", "-o", folder / "joints.csv")
    with (folder / "joints.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert {row["status"] for row in rows} == {"ok"}
    q3, q4 = ([float(row[name]) for row in rows] for name in ("q3_deg", "q4_um"))
    assert np.ptp(q3) < 0.01
    assert np.ptp(q4) == pytest.approx(200.0, abs=1.0)


def test_the_second_session_is_followed(folder):
    sweeps = folder / "sweeps.csv"
    fpcal("track", sweeps, "--estimate", folder / "now.json", "--json", folder / "track.json")
    sessions = json.loads((folder / "track.json").read_text())["sessions"]
    assert [entry["verdict"] for entry in sessions] == ["as-modelled", "as-modelled"]
    assert read_estimate(folder / "now.json", CELL).time_h == 24.0
    fpcal("decide", sweeps, "--tolerance-nm", 80, "--json", folder / "decide.json")
    assert json.loads((folder / "decide.json").read_text())["decision"]["action"] in ("hold", "extrinsic")
    fpcal("doctor", sweeps, "--json", folder / "doctor.json")
    findings = json.loads((folder / "doctor.json").read_text())["findings"]
    assert [f for f in findings if f["severity"] == "problem"] == []


def test_what_its_report_says(folder):
    facts = gather(folder / "sweeps.csv", CELL, goal=Goal(80.0))
    assert [outlook.name for outlook in facts.tasks if outlook.prediction is None] == []
    assert verdict(facts).word in ("Hold", "Re-identify")
    assert "tolerance 80 nm" in verdict(facts).sentences[-1]
