"""Sizes of the drift from data."""

import json
from pathlib import Path

import numpy as np
import pytest
from track_fixtures import CELL, campaign

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.sweeps import write_sweeps
from fpcal_bayes.tracking.fit_sizes import fit_sizes, maximise, profile_interval


def walk_likelihood(increments: np.ndarray):
    """Log likelihood of the factor on a random walk whose increments are seen without noise."""

    def log_likelihood(log_factor: np.ndarray) -> float:
        factor = np.exp(log_factor[0])
        return float(-len(increments) * np.log(factor) - 0.5 * (increments**2).sum() / factor**2)

    return log_likelihood


def test_the_maximum_and_its_interval_are_those_of_the_exact_case():
    increments = np.random.default_rng(0).standard_normal(5) * 3.0
    log_likelihood = walk_likelihood(increments)
    best, top = maximise(log_likelihood, 1)
    scale = np.sqrt((increments**2).mean())
    assert np.exp(best[0]) == pytest.approx(scale, rel=0.02)
    low, high = profile_interval(log_likelihood, best, top, 0, 0.95)
    # n (s^2/f^2 - 1 + 2 log(f/s)) passes 3.841 at the ends.
    for end in (low, high):
        assert 5 * (scale**2 / end**2 - 1 + 2 * np.log(end / scale)) == pytest.approx(3.841, rel=0.1)
    assert low < scale < high


def test_five_epochs_cover_the_truth_as_often_as_stated():
    random, hits = np.random.default_rng(1), 0
    for _ in range(100):
        log_likelihood = walk_likelihood(random.standard_normal(5))
        best, top = maximise(log_likelihood, 1)
        low, high = profile_interval(log_likelihood, best, top, 0, 0.9)
        hits += low < 1.0 < high
    # The chi-square law of the likelihood ratio is a little narrow for five increments.
    assert 0.78 * 100 < hits < 0.97 * 100


def test_a_likelihood_that_never_falls_has_no_end():
    low, high = profile_interval(lambda x: -float(np.exp(x[0])) * 10, np.array([np.log(0.01)]), -0.1, 0, 0.95)
    assert low == 0.0
    assert 0.01 < high < 1.0


def test_the_filter_finds_the_size_of_a_simulated_walk():
    """Five sessions: the factor of mirror and fibre is found within an interval that holds one, and is wide."""
    _, sweeps = campaign(7, sessions=5, hours=8.0)
    found = fit_sizes(CELL, sweeps, [[p.name for p in CELL.select("extrinsic")]])
    (factor,) = found.factors
    assert factor.low < 1.0 < factor.high
    assert 0.5 < factor.value < 2.0
    assert factor.high / factor.low > 1.5


def test_the_command_says_which_sizes_the_sessions_support(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, sweeps = campaign(7, sessions=2, hours=8.0)
    write_sweeps("week.csv", sweeps, CELL)
    assert main(["track", "week.csv", "--fit-drift", "--json", "out.json"]) == 0
    found = json.loads(Path("out.json").read_text())["drift_fit"]
    assert [group["parameters"][0] for group in found["groups"]] == ["beta_4", "beta_et"]
    assert found["level"] == 0.95
    sizes = {size.name: size for size in CELL.drift}
    assert set(found["walks"]) == set(sizes)
    for group in found["groups"]:
        assert group["low"] <= group["factor"] <= (np.inf if group["high"] is None else group["high"])
        for name in group["parameters"]:
            entry, parameter = found["walks"][name], CELL.free[name]
            assert entry["cell"] == pytest.approx(parameter.shown(sizes[name].walk))
            assert entry["fitted"] == pytest.approx(group["factor"] * entry["cell"])
    out = capsys.readouterr().out
    assert "random walks after one day that these sessions support, with 95% intervals:" in out
    assert "beta_et" in out
    assert "the cell states 0.034" in out


def test_refuses_what_it_cannot_learn_from():
    _, sweeps = campaign(7, sessions=1)
    with pytest.raises(InputError, match="expected sessions after the calibration"):
        fit_sizes(CELL, sweeps.of_session("day0"), [["x_wf"]])
    with pytest.raises(InputError, match="none of alpha_2 drifts"):
        fit_sizes(CELL, sweeps, [["alpha_2"]])
