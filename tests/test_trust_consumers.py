"""One file, one verdict: every command that takes an estimate honours what is held against it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fpcal_bayes as fp
from fpcal_bayes.cli.main import main, make_parser

# A perfect mechanism: with error motions a noise that is stated too small is explained by these.
CELL = fp.load_cell(mechanics="none")
REASON = "poor fit"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Sweeps whose noise is four times what they state, and what the commands make of them."""
    made = tmp_path_factory.mktemp("doubt")
    sweeps = fp.simulate(CELL, fp.paper_truth(CELL), fp.paper_protocol(CELL, midpoints=True), sigma_nm=20, seed=1)
    wrong = replace(sweeps, sigma=sweeps.sigma / 4.0)
    fp.write_sweeps(made / "sweeps.csv", wrong, CELL)
    fp.write_sweeps(made / "campaign.h5", wrong, CELL)
    good = fp.simulate(CELL, fp.paper_truth(CELL), fp.paper_protocol(CELL), sigma_nm=5, seed=2)
    fp.write_sweeps(made / "good.csv", good, CELL)
    run(made, "identify sweeps.csv --json estimate.json")
    run(made, "sample sweeps.csv --draws 50 -o posterior.nc --json posterior.json")
    run(made, "control --estimate estimate.json --task circle --points 9 -o joints.csv")
    run(made, "simulate --path joints.csv --traces -o driven.csv")
    run(made, "simulate --traces -o index.h5 --protocol good.csv")
    return made


def run(folder: Path, line: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return main([*line.split(), "--mechanics", "none", "--quiet"])


#: What each option that names an estimate, a posterior or a campaign is tried with; JSON goes to out.json.
TRIED = {
    ("task-error", "file"): "task-error estimate.json --tolerance-nm 50",
    ("task-error", "estimate"): "task-error posterior.nc --estimate estimate.json --tolerance-nm 50",
    ("control", "estimate"): "control --estimate estimate.json --task circle --points 9 -o j.csv",
    ("check", "estimate"): "check driven.csv --estimate estimate.json --tolerance-nm 50",
    ("plan", "estimate"): "plan --for extrinsic --n 1 --draws 2 --candidates 30 --estimate estimate.json -o p.csv",
    ("plan", "after"): "plan --n 1 --draws 2 --candidates 30 --after sweeps.csv -o p.csv",
    ("identify", "start"): "identify good.csv --free extrinsic --start estimate.json",
    ("identify", "prior"): "identify good.csv --prior estimate.json",
    ("track", "campaign"): "track campaign.h5",
    ("decide", "campaign"): "decide campaign.h5",
    ("report", "campaign"): "report campaign.h5 -o r.html",
    ("report", "posterior"): "report campaign.h5 --posterior posterior.nc -o r.html",
    ("doctor", "file"): "doctor sweeps.csv",
    ("observe", "file"): "observe sweeps.csv",
    ("identify", "file"): "identify sweeps.csv",
    ("certificate", "file"): "certificate estimate.json -o handed",
    ("verify", "file"): "verify sweeps.csv --validation good.csv",
}
#: These take an estimate for its geometry alone, and promise nothing from it.
GEOMETRY = {("ingest", "estimate"), ("measure", "estimate"), ("cell", "file")}
#: These take moves or rows as they are, and promise nothing from them.
AS_THEY_ARE = {("export", "file"), ("trace", "file"), ("append", "campaign")}
#: Its rounds do what track and decide do, through the same functions; the estimate is its output.
ROUNDS = {("keep", "campaign"), ("keep", "estimate")}
#: tests/test_serve.py asks it for joints from estimates that are not to be used.
SERVED = {("serve", "campaign"), ("serve", "estimate")}
#: These sample the posterior of an identification, whose trust theirs is; it takes minutes where the fit is poor.
OTHERS = {("sample", "file"), ("sample", "prior"), ("compare", "file")}


def test_every_option_that_takes_a_result_is_tried():
    parser = make_parser()
    commands = next(action.choices for action in parser._actions if action.dest == "command")
    names = {"estimate", "start", "prior", "posterior", "campaign", "after", "file"}
    found = {
        (name, action.dest)
        for name, command in commands.items()
        for action in command._actions
        if action.dest in names and not (action.option_strings and action.metavar == "OUT")
    }
    missing = {
        pair
        for pair in found - set(TRIED) - GEOMETRY - OTHERS - AS_THEY_ARE - ROUNDS - SERVED
        if pair != ("measure", "campaign")
    }
    assert missing == set(), "say how each command honours the trust of what it is given"


@pytest.mark.slow
@pytest.mark.parametrize("line", TRIED.values(), ids=["-".join(pair) for pair in TRIED])
def test_the_verdict_is_the_same_everywhere(folder, line, capsys):
    assert run(folder, f"{line} --json out.json") == 0
    said = json.loads((folder / "out.json").read_text())
    trust = said["trust"]
    assert (trust["usable"], trust["verdict"]) == (False, "unusable")
    assert any(REASON in reason["text"] or reason["kind"] == "problem" for reason in trust["reasons"])
    assert len(said["content_sha256"]) == 64
    assert said.get("valid_until_h") is None
    for task in said.get("tasks", {}).values():
        assert task["peak_to_peak_nm"]["high"] is None
        assert task.get("exceeds_probability") is None
        assert set(task["band_nm"]["low"]) == {None}
    if "decision" in said:
        assert set(said["decision"]["probability_out"].values()) == {None}
        assert "do not use" in said["decision"]["sentence"]
    if "check" in said:
        assert (said["check"]["verdict"], said["check"]["probability"]) == ("not evaluated", None)
    if "expected_sd_nm" in said:
        assert said["expected_sd_nm"] is None
    if line.startswith("control"):
        rows = (folder / "j.csv").read_text().splitlines()[1:]
        assert {row.split(",")[-1] for row in rows} == {""}
    if not line.startswith(("doctor", "observe")):
        assert REASON in capsys.readouterr().err


def test_a_controller_refuses_what_is_not_to_be_used(folder):
    estimate = fp.read_estimate(folder / "estimate.json", CELL)
    with pytest.raises(fp.InputError, match="not to be driven with: poor fit"):
        fp.Controller(estimate)
    assert fp.Controller(estimate, accept_untrusted=True).q.shape == (6,)
    with pytest.raises(fp.InputError, match="nothing is planned"):
        fp.plan(CELL, 2, estimate=estimate)
    task = fp.find_task(CELL, estimate.vector(), "circle").driven()
    prediction = fp.predict_from_covariance(estimate, task)
    for ask in (prediction.band, prediction.peak_to_peak_band, lambda: prediction.exceeds(0.05)):
        with pytest.raises(fp.InputError, match="no band and no probability"):
            ask()


def test_an_edited_estimate_is_refused(folder, tmp_path):
    content = json.loads((folder / "estimate.json").read_text())
    content["trust"] = fp.Trust().content()
    (tmp_path / "edited.json").write_text(json.dumps(content))
    with pytest.raises(fp.InputError, match="content_sha256: the content is not what the program wrote"):
        fp.read_estimate(tmp_path / "edited.json", CELL)
    del content["content_sha256"], content["trust"]
    (tmp_path / "older.json").write_text(json.dumps(content))
    assert fp.read_estimate(tmp_path / "older.json", CELL).trust.verdict == "doubtful"


def test_units_cannot_be_mistaken():
    """The examples of a wrong unit that used to be taken in silence."""
    truth, plan = fp.paper_truth(CELL), fp.paper_protocol(CELL)
    with pytest.raises(TypeError, match="sigma"):
        fp.simulate(CELL, truth, plan, sigma=5, seed=0)
    with pytest.raises(TypeError, match="tolerance"):
        fp.Goal(tolerance=50)
    assert fp.Goal(50).tolerance_nm == 50
    with pytest.raises(TypeError, match="sigma"):
        fp.Costs(sigma=5)
    assert not hasattr(fp.Sweeps, "make")
    start = np.zeros((1, 6))
    end = start.copy()
    end[0, 5] = 90.0
    with pytest.raises(fp.InputError, match=re.escape("q6_end_deg: 5156.62 deg is more than two turns from zero")):
        fp.simulate(CELL, truth, fp.Sweeps.of_um_rad(start, end), sigma_nm=5, seed=0)
    right = fp.Sweeps.of_um_deg(CELL, start, end)
    assert right.q_end[0, 5] == pytest.approx(np.pi / 2)
    assert np.isfinite(fp.simulate(CELL, truth, right, sigma_nm=5, seed=0).dl).all()
    estimate = fp.identify(CELL, fp.simulate(CELL, truth, plan, sigma_nm=5, seed=0)).estimate
    with pytest.raises(TypeError, match="rotation"):
        fp.Controller(estimate).move(rotation=(0, 1, 0))
    with pytest.raises(fp.InputError, match="rotation_deg: expected three finite numbers"):
        fp.Controller(estimate).move(rotation_deg=(0, 1))
    with pytest.raises(fp.InputError, match="unknown task"):
        fp.find_task(CELL, estimate.vector(), "squares")
    with pytest.raises(fp.InputError, match="vector of shape"):
        fp.find_task(CELL, estimate.vector()[:-1], "circle")
    goniometer = CELL.joints[3]
    if goniometer.controller is not None:
        assert goniometer.from_controller(goniometer.to_controller(2.0)) == pytest.approx(2.0)
