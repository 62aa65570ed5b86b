"""Sessions of an unchanged cell taken together, and an earlier estimate as the prior of a later one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fpcal_bayes as fp
from fpcal_bayes.cli.main import main
from fpcal_bayes.infer.fit.prior import bends
from fpcal_bayes.io.sweeps import packed, unpacked
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics
from fpcal_bayes.model.mechanics import Terms, design

CELL = fp.load_cell(mechanics="none")


@pytest.fixture(scope="module")
def truth() -> Truth:
    """A cell from the prior, well off nominal, where the data's surface bends."""
    values = CELL.free.nominal + CELL.free.prior_sd * np.random.default_rng(4).standard_normal(len(CELL.free))
    return Truth(CELL.free, np.zeros(1), values[None])


@pytest.fixture(scope="module")
def days(truth) -> list[Sweeps]:
    return [fp.simulate(CELL, truth, fp.paper_protocol(CELL), sigma_nm=5, seed=seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, days) -> Path:
    made = tmp_path_factory.mktemp("days")
    for name, part in zip("ab", days, strict=True):
        fp.write_sweeps(made / f"{name}.csv", part, CELL)
    second = replace(days[1], session=np.full(len(days[1]), "second"))
    fp.write_sweeps(made / "both.csv", join([days[0], second]), CELL)
    assert run(made, "identify a.csv --json a.json") == 0
    return made


def run(folder: Path, line: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return main([*line.split(), "--mechanics", "none", "--quiet"])


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def same(left: dict, right: dict) -> None:
    for name, entry in left["parameters"].items():
        other = right["parameters"][name]
        assert entry["value"] == pytest.approx(other["value"], abs=1e-6 * other["sd"])
        assert entry["sd"] == pytest.approx(other["sd"], rel=1e-6)


def test_a_prior_says_what_its_sweeps_say(folder, truth):
    assert run(folder, "identify b.csv --prior a.json --json b.json") == 0
    assert run(folder, "identify both.csv --session full-T0,second --json both.json") == 0
    found = read(folder / "b.json")
    same(found, read(folder / "both.json"))
    assert found["fit"]["n_sweeps"] == 138
    values = CELL.free.to_shown(truth.values[0])
    z = [(e["value"] - v) / e["sd"] for e, v in zip(found["parameters"].values(), values, strict=True)]
    # Two thousand of these lie within four standard deviations.
    assert np.abs(z).max() < 4.0
    # No day sees the distance along the axis.
    assert found["parameters"]["y_wf"]["sd"] == pytest.approx(found["parameters"]["y_wf"]["prior_sd"], rel=0.02)
    # What was taken along travels on.
    assert len(fp.io.estimate.read_estimate_rows(folder / "b.json", CELL)) == 138


def test_draws_follow_the_pooled_sweeps(folder):
    assert run(folder, "sample b.csv --prior a.json --draws 100 -o b.nc --json b_draws.json") == 0
    assert run(folder, "identify b.csv --prior a.json --json b.json") == 0
    drawn, fitted = read(folder / "b_draws.json"), read(folder / "b.json")
    assert drawn["fit"]["n_sweeps"] == 138
    for name in ("beta_et", "theta_wf", "z_wf", "y_wf"):
        assert drawn["parameters"][name]["sd"] == pytest.approx(fitted["parameters"][name]["sd"], rel=0.25)


@pytest.mark.parametrize("line", ["identify a.csv --prior a.json", "identify copy.csv --prior a.json"])
def test_the_same_readings_count_once(folder, days, line, capsys):
    copy = replace(days[0].take(np.arange(40)), time_h=np.full(40, 24.0), session=np.full(40, "another"))
    fp.write_sweeps(folder / "copy.csv", copy, CELL)
    assert run(folder, line) == 2
    assert "hold the same readings" in capsys.readouterr().err


def test_sessions_of_one_file_count_once(folder, days, capsys):
    twice = join([days[0], replace(days[0], session=np.full(69, "again"))])
    fp.write_sweeps(folder / "twice.csv", twice, CELL)
    assert run(folder, "identify twice.csv --session full-T0,again") == 2
    assert run(folder, "identify both.csv --session second,second") == 2
    assert run(folder, "identify both.csv --session second,third") == 2
    said = capsys.readouterr().err
    assert "hold the same readings (69 rows)" in said
    assert "'second' is named twice" in said
    assert "no session 'third'" in said


def test_few_coarse_readings_may_agree_by_chance(days):
    """Nanometres with 5 nm of noise: two of twelve readings alike are chance, twelve are one file."""
    coarse = [replace(day, dl=day.dl.round(3)).take(np.arange(12)) for day in days]
    alike = coarse[1].dl.copy()
    alike[:2] = coarse[0].dl[:2]
    assert len(fp.pool([coarse[0], replace(coarse[1], dl=alike)])) == 24
    with pytest.raises(fp.InputError, match="hold the same readings"):
        fp.pool([coarse[0], replace(coarse[1], dl=coarse[0].dl)])


def test_values_and_covariance_alone_are_refused(folder, days, capsys):
    content = read(folder / "a.json")
    content |= {"rows": None}
    del content["content_sha256"]
    (folder / "bare.json").write_text(json.dumps(content))
    assert run(folder, "identify b.csv --prior bare.json") == 2
    assert "bare.json: key rows: none are there" in capsys.readouterr().err
    bare = fp.read_estimate(folder / "bare.json", CELL)
    assert bends(bare)
    found = fp.identify(CELL, days[1], prior=bare)
    assert not found.estimate.trust.usable
    assert any("surface bends" in warning for warning in found.warnings)


def test_two_directions_measured_otherwise_are_a_normal_prior(folder):
    estimate = fp.read_estimate(folder / "a.json", CELL)
    direction = estimate.parameters.positions(["beta_wf", "theta_wf"])
    own = replace(
        estimate,
        parameters=estimate.parameters[direction[0] : direction[1] + 1],
        values=estimate.values[direction],
        covariance=np.radians(0.01) ** 2 * np.array([[1.0, 0.9], [0.9, 1.0]]),
        status=("identified",) * 2,
    )
    assert not bends(own)


def test_rows_travel_whole(days):
    sweeps = fp.simulate(CELL, fp.paper_truth(CELL), fp.paper_protocol(CELL, midpoints=True), sigma_nm=5, seed=3)
    again = unpacked(packed(sweeps, CELL), "x.json", CELL)
    np.testing.assert_allclose(again.dl, sweeps.dl, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(again.group, sweeps.group)
    for text in ("no base64", packed(sweeps, CELL)[:-40]):
        with pytest.raises(fp.InputError, match=r"x\.json"):
            unpacked(text, "x.json", CELL)
    many = join([sweeps] * 60)
    assert packed(replace(many, dl=many.dl + np.random.default_rng(0).standard_normal(len(many))), CELL) is None


def test_sessions_share_the_machine_and_have_their_own_drift(days):
    """The covariance of pooled rows against a sum over weights that are drawn once, or once per session."""
    stage = JointMechanics(straightness_nm=30, linearity=45, reversal=10, return_sd=2)
    sizes = Mechanics((stage,) * 3 + (JointMechanics(reversal=1),) * 3, drift_nm_per_min=3.0)
    terms, vector = Terms.of(CELL, sizes, CELL.free.names), CELL.parameters.nominal
    apart = [design(terms, vector, drive_of_sweeps(day, 1.0), day.sigma) for day in days]
    pooled = fp.pool(days)
    # Rows of two sessions may stand in any order.
    mixed = np.argsort(np.tile(np.arange(69), 2), kind="stable")
    for rows, back in ((np.arange(138), np.arange(138)), (mixed, np.argsort(mixed))):
        chosen = pooled.take(rows)
        together = design(terms, vector, drive_of_sweeps(chosen, 1.0), chosen.sigma)
        covariance = (together.matrix @ together.matrix.T)[np.ix_(back, back)]
        for i, own in enumerate(apart):
            part = covariance[69 * i : 69 * (i + 1), 69 * i : 69 * (i + 1)]
            np.testing.assert_allclose(part, own.matrix @ own.matrix.T, atol=1e-14)
        shared = [own.matrix[:, : own.motion_count] for own in apart]
        np.testing.assert_allclose(covariance[:69, 69:], shared[0] @ shared[1].T, atol=1e-14)
        assert together.motion_count == apart[0].motion_count
        assert sum(name.startswith("drift along") for name in together.names) == 6
