"""Sizes of the drift from data."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from track_fixtures import CELL, campaign

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell, write_resized_cell
from fpcal_bayes.io.sweeps import write_sweeps
from fpcal_bayes.tracking.fit_sizes import fit_sizes, profile_interval
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.tracker import track

GRID = np.linspace(np.log(1e-2), np.log(1e2), 41)


def walk_profile(increments: np.ndarray) -> np.ndarray:
    """Log likelihood of factors on a random walk whose increments are seen without noise, on the grid."""
    return -len(increments) * GRID - 0.5 * (increments**2).sum() * np.exp(-2.0 * GRID)


def test_the_maximum_and_its_interval_are_those_of_the_exact_case():
    increments = np.random.default_rng(0).standard_normal(5) * 3.0
    best, low, high = profile_interval(GRID, walk_profile(increments), 0.95)
    scale = np.sqrt((increments**2).mean())
    assert best == pytest.approx(scale, rel=0.02)
    # n (s^2/f^2 - 1 + 2 log(f/s)) passes 3.841 at the ends.
    for end in (low, high):
        assert 5 * (scale**2 / end**2 - 1 + 2 * np.log(end / scale)) == pytest.approx(3.841, rel=0.1)
    assert low < scale < high


def test_five_epochs_cover_the_truth_as_often_as_stated():
    random, hits = np.random.default_rng(1), 0
    for _ in range(100):
        _, low, high = profile_interval(GRID, walk_profile(random.standard_normal(5)), 0.9)
        hits += low < 1.0 < high
    # The chi-square law of the likelihood ratio is a little narrow for five increments.
    assert 0.78 * 100 < hits < 0.97 * 100


def test_a_likelihood_that_never_falls_has_no_end():
    _, low, high = profile_interval(GRID, -np.exp(GRID) * 10, 0.95)
    assert low == 0.0
    assert 0.01 < high < 1.0


def test_the_filter_finds_the_size_of_a_simulated_walk():
    """Five sessions: the factor of mirror and fibre is found within an interval that holds one, and is wide."""
    _, sweeps = campaign(7, sessions=5, hours=8.0)
    factor = fit_sizes(track(CELL, sweeps), check_sessions(sweeps)).factors[1]
    assert "x_wf" in factor.names
    assert factor.low < 1.0 < factor.high
    assert 0.5 < factor.value < 2.0
    assert factor.high / factor.low > 1.5


def test_the_command_says_which_sizes_the_sessions_support(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, sweeps = campaign(7, sessions=2, hours=8.0)
    write_sweeps("week.csv", sweeps, CELL)
    assert main(["track", "week.csv", "--fit-drift", "--json", "out.json", "-o", "own.toml"]) == 0
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
    own = load_cell("own.toml")
    assert own.sha256 == CELL.sha256
    for size in own.drift:
        assert size.walk == pytest.approx(CELL.free[size.name].scale * found["walks"][size.name]["fitted"], rel=1e-3)
    out = capsys.readouterr().out
    assert "fpcal track week.csv --cell own.toml" in out
    assert "random walks after one day that these sessions support, with 95% intervals:" in out
    assert "beta_et" in out
    assert "the cell states 0.034" in out

    # What is there stays, unless it is to be written over.
    before = Path("own.toml").read_bytes()
    assert main(["track", "week.csv", "--fit-drift", "-o", "own.toml"]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["track", "week.csv", "-o", "other.toml"]) == 2
    assert Path("own.toml").read_bytes() == before
    assert main(["track", "week.csv", "--fit-drift", "-o", "own.toml", "--force"]) == 0


def test_a_cell_is_written_again_however_its_walks_stand(tmp_path):
    text = data_file("femto-st.toml").read_text()
    walks = "[extrinsic.drift.beta_et]\n# walk_deg = 3\nwalk_deg=0.01 # of 2026\n[extrinsic.drift]\n"
    (tmp_path / "own.toml").write_text(text.replace("[extrinsic.drift]\nbeta_et = { walk_deg = 0.010 }\n", walks))
    write_resized_cell(tmp_path / "own.toml", 2.0, 0.5, tmp_path / "new.toml")
    sizes = {size.name: size.walk for size in CELL.drift}
    for size in load_cell(tmp_path / "new.toml").drift:
        assert size.walk == pytest.approx(sizes[size.name] * (0.5 if size.name[-2:] in ("et", "wf") else 2.0), rel=1e-3)
    assert "# walk_deg = 3" in (tmp_path / "new.toml").read_text()


def test_refuses_what_it_cannot_learn_from():
    _, sweeps = campaign(7, sessions=1)
    found = track(CELL, sweeps)
    with pytest.raises(InputError, match="expected sessions after the calibration"):
        fit_sizes(replace(found, outcomes=found.outcomes[:1]), check_sessions(sweeps.of_session("day0")))
    still = replace(found, drift=found.drift.resized(lambda size: replace(size, walk=0.0)))
    with pytest.raises(InputError, match="no parameter of cell 'femto-st' walks"):
        fit_sizes(still, check_sessions(sweeps))
