"""A calibration is verified by sweeps that it was not made from."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import fpcal_bayes as fp
from fpcal_bayes.cli.main import main
from fpcal_bayes.infer.verification.choice import validation_plan
from fpcal_bayes.infer.verification.expected import Expected
from fpcal_bayes.infer.verification.power import LEVEL, Effects, power_of
from fpcal_bayes.infer.verification.verify import kept_rows, verify
from fpcal_bayes.measure import Truth
from fpcal_bayes.measure.protocol import read_often
from fpcal_bayes.model.parameters import ParameterSet

CELL = fp.load_cell(mechanics="none")
TRUTH = fp.paper_truth(CELL)


@pytest.fixture(scope="module")
def sweeps():
    return fp.simulate(CELL, TRUTH, fp.paper_protocol(CELL, midpoints=True), sigma_nm=5, seed=1)


@pytest.fixture(scope="module")
def found(sweeps):
    return fp.identify(CELL, sweeps)


@pytest.fixture(scope="module")
def plan(found):
    return validation_plan(found, 6, tasks=["circle", "spin"], candidates=60)


def together(sweeps, fresh):
    rows = fp.pool([sweeps, fresh])
    return rows, np.arange(len(rows)) < len(sweeps)


def measured(plan, *, seed, truth=TRUTH, cell=CELL):
    return fp.simulate(cell, truth, read_often(plan.sweeps, plan.readings), sigma_nm=5, seed=seed)


def test_the_covariance_is_that_of_a_conditional_normal(sweeps, found, plan):
    """Against the inverse of the joint precision, which is made the other way round."""
    rows, fitted = together(sweeps, measured(plan, seed=3))
    expected = Expected.of(found, rows, fitted)
    noise = np.zeros((len(rows), len(rows)))
    same = (rows.group[:, None] == rows.group) & (rows.session[:, None] == rows.session) & (rows.group != "")
    noise[same] = 0.5 * 25e-6
    np.fill_diagonal(noise, 25e-6)
    precision = np.linalg.inv(expected.geometry @ expected.geometry.T + noise)
    own = np.linalg.inv(precision[np.ix_(~fitted, ~fitted)])
    assert np.allclose(expected.covariance, own, rtol=1e-4, atol=1e-9)


def test_the_score_is_that_of_the_innovation_where_nothing_bends(sweeps, found, plan):
    rows, fitted = together(sweeps, measured(plan, seed=4))
    expected = Expected.of(found, rows, fitted)
    linear = expected.innovation @ np.linalg.solve(expected.covariance, expected.innovation)
    assert expected.score() == pytest.approx(linear, rel=0.05)


def test_good_calibrations_have_uniform_p_values(sweeps, found, plan):
    """The same calibration against truths of its own posterior, to first order: chi-square by its definition."""
    rng = np.random.default_rng(5)
    rows, fitted = together(sweeps, measured(plan, seed=6))
    expected = Expected.of(found, rows, fitted)
    drawn = rng.standard_normal((400, (~fitted).sum())) @ np.linalg.cholesky(expected.covariance).T
    scores = np.einsum("ki,ij,kj->k", drawn, np.linalg.inv(expected.covariance), drawn)
    assert stats.kstest([expected.p_value(score) for score in scores], "uniform").pvalue > 0.01


def test_the_power_is_that_of_simulated_scores():
    rng = np.random.default_rng(7)
    shift = np.full(12, 1.5)
    scores = ((rng.standard_normal((20_000, 12)) + shift) ** 2).sum(axis=1)
    assert power_of(np.array([shift @ shift]), 12)[0] == pytest.approx(
        (scores > stats.chi2.isf(LEVEL, 12)).mean(), abs=0.015
    )
    found = Effects(("a", "b"), np.array([shift, 0 * shift])).power(np.eye(12))
    assert found["b"] == pytest.approx(LEVEL)
    assert found["a"] > 0.5


def test_a_good_calibration_passes_and_says_for_what(sweeps, found, plan):
    rows, fitted = together(sweeps, measured(plan, seed=8))
    made = verify(found, rows, fitted, tasks=["circle"])
    assert made.verdict == "PASS"
    assert not made.reasons
    assert 0.8 <= made.coverage <= 1.0
    assert made.n_rows == 24
    assert "tilts of the mirror up to" in made.scope[0]


def test_an_error_between_the_sweeps_fails(sweeps, found, plan):
    """A gain of q1 that the calibration does not hold, on the second day only."""
    cell = fp.load_cell(mechanics="none")
    other = cell.parameters["gain_1"]
    values = np.append(TRUTH.values[0], other.nominal + 1e-3)
    wrong = Truth(ParameterSet((*TRUTH.parameters, other)), TRUTH.times_h[:1], values[None])
    rows, fitted = together(sweeps, measured(plan, seed=8, truth=wrong))
    made = verify(found, rows, fitted, tasks=["circle"])
    assert made.verdict == "FAIL"
    assert made.reasons[0].kind == "verification"
    assert "those of q" in made.reasons[0].text


def test_sweeps_that_could_not_show_it_do_not_pass(sweeps, found):
    """One short sweep of the last joint tells nothing of a circle."""
    whole = fp.paper_protocol(CELL)
    one = whole.take((whole.q_start != whole.q_end)[:, 5]).take(np.array([0]))
    short = replace(one, q_end=one.q_start + 0.02 * (one.q_end - one.q_start))
    rows, fitted = together(sweeps, fp.simulate(CELL, TRUTH, short, sigma_nm=5, seed=9))
    made = verify(found, rows, fitted, tasks=["circle"])
    assert made.verdict == "NOT EVALUATED"
    assert made.least_power("circle")[1] < 0.5
    assert any("was not tried" in line for line in made.scope)


def test_whole_sweeps_are_held_out_of_every_joint(sweeps):
    kept = kept_rows(sweeps, 0.2)
    out, groups = sweeps.take(~kept), set(sweeps.take(kept).group.tolist())
    assert not groups & set(out.group.tolist())
    assert (out.q_start != out.q_end).any(axis=0).all()
    assert 0.1 < (~kept).mean() < 0.3
    with pytest.raises(fp.InputError, match="expected a larger share"):
        kept_rows(sweeps, 1e-4)


def test_the_commands_write_the_verdict(tmp_path, sweeps, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fp.write_sweeps("a.csv", sweeps, CELL)
    none = ["--mechanics", "none", "--quiet"]
    assert main(["plan", "--validation", "4", "--after", "a.csv", "--tasks", "circle", "-o", "v.csv", *none]) == 0
    assert "readings" in (tmp_path / "v.csv").read_text().splitlines()[0]
    assert main(["simulate", "--protocol", "v.csv", "-o", "b.csv", "--seed", "3", *none]) == 0
    assert main(["identify", "a.csv", "--hold-out", "0.2", "--json", "a.json", *none]) == 0
    assert json.loads((tmp_path / "a.json").read_text())["verification"]["verdict"] in ("PASS", "NOT EVALUATED")
    capsys.readouterr()
    assert main(["verify", "a.json", "--validation", "b.csv", "--task", "circle", "--json", "v.json", *none]) == 0
    made = json.loads((tmp_path / "v.json").read_text())
    assert made["verification"]["tasks"]["circle"]["verdict"] == made["verification"]["verdict"] == "PASS"
    assert main(["certificate", "a.json", "--verification", "v.json", "-o", "good", *none]) == 0
    assert json.loads((tmp_path / "good" / "certificate.json").read_text())["certificate"]["calibrated"] is True
    fresh = fp.read_sweeps("b.csv", CELL)
    fp.write_sweeps("moved.csv", replace(fresh, dl=fresh.dl + 0.05), CELL)
    assert main(["verify", "a.json", "--validation", "moved.csv", "--task", "circle", "--json", "w.json", *none]) == 0
    assert main(["certificate", "a.json", "--verification", "w.json", "-o", "bad", *none]) == 0
    said = json.loads((tmp_path / "bad" / "certificate.json").read_text())["certificate"]
    assert (said["calibrated"], said["verification"]["verdict"]) == (False, "FAIL")
    assert main(["report", "a.csv", "--verification", "w.json", "-o", "r.html", *none]) == 0
    page = (tmp_path / "r.html").read_text()
    assert "Verification failed" in page
    assert "Verification: FAIL" in page
    capsys.readouterr()
    assert main(["report", "a.csv", "--verification", "a.csv", "-o", "s.html", *none]) == 2
    assert "not a JSON file" in capsys.readouterr().err
    written = json.loads((tmp_path / "w.json").read_text())
    (tmp_path / "x.json").write_text(json.dumps(written | {"time_h": 5.0}))
    assert main(["certificate", "a.json", "--verification", "x.json", "-o", "other", *none]) == 2
    assert "is not what the program wrote" in capsys.readouterr().err
    assert main(["verify", "a.csv", "--validation", "a.csv", *none]) == 2
    assert "hold the same readings" in capsys.readouterr().err
    assert main(["verify", "a.json", "--validation", "no.csv", *none]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["verify", "a.csv", "--validation", sweeps.sessions[0], *none]) == 2
    assert "is the calibration itself" in capsys.readouterr().err
    assert main(["plan", "--validation", "4", "-o", "w.csv", *none]) == 2
    assert "expected --after FILE" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [{"n": 0}, {"n": -1}, {"n": 3, "sigma": 0.0}, {"n": 3, "sigma": np.nan}])
def test_numbers_of_a_validation_plan_are_above_zero(found, wrong):
    with pytest.raises(fp.InputError, match="expected numbers above zero"):
        validation_plan(found, **wrong)
