"""The command ``fpcal doctor``: each fault that is put into good sweeps is found, and nothing else is."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fpcal_bayes.analysis.doctor import doctor
from fpcal_bayes.cli.main import main
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
#: What is said of the paper's sweeps, good as they are.
ALWAYS = {"rank", "gauges", "limits", "second solution"}


@pytest.fixture(scope="module")
def good():
    return simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL), sigma=0.005, seed=4)


def kinds(sweeps, cell=CELL) -> set[str]:
    return {finding.kind for finding in doctor(sweeps, cell)} - ALWAYS


def only(sweeps, kind: str, cell=CELL):
    """The one finding of a kind, all others being the usual ones."""
    (finding,) = [f for f in doctor(sweeps, cell) if f.kind not in ALWAYS]
    assert finding.kind == kind
    assert finding.remedy
    return finding


def test_good_sweeps_raise_no_problem(good):
    found = doctor(good, CELL)
    assert {finding.kind for finding in found} == ALWAYS
    assert not [finding for finding in found if finding.severity == "problem"]
    assert any("midpoint" in finding.remedy for finding in found if finding.kind == "rank")


def test_slipped_counts(good):
    dl = good.dl.copy()
    dl[20] += CELL.wavelength / 2
    finding = only(replace(good, dl=dl), "slips")
    assert f"{good.label[20]} (" in finding.what


def test_outliers(good):
    dl = good.dl.copy()
    dl[33] += 0.2
    assert str(good.label[33]) in only(replace(good, dl=dl), "outliers").what


def test_sigma_too_small_and_too_large(good):
    small = only(replace(good, sigma=good.sigma / 2), "fit")
    assert small.severity == "problem"
    assert float(small.what.split(" times")[0].split()[-1]) == pytest.approx(2.0, abs=0.4)
    # Another sigma would mend the number and not the tasks.
    assert "do not use" in small.remedy
    assert "raise sigma" not in small.remedy
    assert "closer to the fit" in only(replace(good, sigma=good.sigma * 3), "sigma").what


def test_repeats_tell_the_noise(good):
    again = replace(good, dl=good.dl + 0.02 * np.random.default_rng(0).standard_normal(len(good)))
    found = doctor(join([good, again]), CELL)
    (said,) = [f for f in found if f.kind == "return"]
    assert "driven again" in said.what
    assert "return_nm" in said.remedy


def test_the_other_path_model(good):
    truth = paper_truth(CELL)
    other = simulate_um(CELL.with_opd("perpendicular"), truth, paper_protocol(CELL), sigma=0.005, seed=1)
    finding = next(f for f in doctor(other, CELL) if f.kind == "path model")
    assert "opd=perpendicular" in finding.remedy


def test_duplicates(good):
    finding = next(f for f in doctor(join([good, good.take(np.arange(3))]), CELL) if f.kind == "duplicates")
    assert finding.severity == "problem"
    assert str(good.label[0]) in finding.what


def test_times(good):
    few = replace(good.take(np.arange(1, 69, 5)), session=np.full(14, "later"))
    assert "times" in kinds(join([good, few]))
    late = replace(few, time_h=np.full(14, 500.0), utc=np.full(14, "2024-05-01T08:00:00Z"))
    early = replace(few, session=np.full(14, "early"), time_h=np.full(14, 5.0), temperature_c=np.full(14, 20.0))
    assert {"clock", "temperature", "gap"} <= kinds(join([good, late, early]))
    overlap = replace(good, time_h=np.linspace(0, 10, 69))
    assert "sessions" in kinds(join([overlap, early]))


def test_signs(good):
    signed = np.ones(69, dtype=bool)
    signed[::7] = False
    finding = next(f for f in doctor(replace(good, signed=signed), CELL) if f.kind == "unsigned")
    assert finding.what.startswith("10 of 69")


def test_joints_that_never_move_and_units(good):
    still = good.take(~(good.q_start != good.q_end)[:, 3])
    assert next(f for f in doctor(still, CELL) if f.kind == "still").what == "no sweep moves q4"
    assert "sigma" in kinds(replace(good, sigma=np.full(69, 5e-6)))
    assert "sigma" in kinds(replace(good, sigma=np.full(69, 0.3)))


def test_what_changed_between_sessions(good):
    truth = paper_truth(CELL)
    knocked = replace(truth, values=truth.values.copy())
    knocked.values[:, truth.parameters.position("beta_et")] += np.radians(0.3)
    plan = paper_protocol(CELL, session="later", time_h=8.0)
    later = simulate_um(CELL, knocked, plan, sigma=0.005, seed=3)
    found = [f for f in doctor(join([good, later]), CELL) if f.kind == "extrinsics-moved"]
    assert [finding.where for finding in found] == ["later"]


def test_a_plan(tmp_path, capsys):
    write_csv(tmp_path / "plan.csv", paper_protocol(CELL), CELL)
    assert main(["doctor", str(tmp_path / "plan.csv"), "--json", str(tmp_path / "d.json")]) == 0
    content = json.loads((tmp_path / "d.json").read_text())
    assert (content["schema"], content["command"]) == ("fpcal/1", "doctor")
    assert {"plan", "rank"} <= {finding["kind"] for finding in content["findings"]}
    assert set(content["findings"][0]) == {"severity", "kind", "session", "what", "remedy"}
    assert "what to do: " in capsys.readouterr().out


def test_what_cannot_be_read(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("nothing\n1\n")
    assert main(["doctor", str(tmp_path / "a.csv")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
