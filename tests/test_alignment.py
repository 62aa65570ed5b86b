"""The fibre's direction by the fringe amplitude: closed forms, truths found again, refusals, the command."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.fringes.alignment import DIRECTION, align
from fpcal_bayes.fringes.amplitude import Amplitudes, fringe_amplitudes, tilting
from fpcal_bayes.fringes.ingest import Ingested, ingest
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.recordings import write_recordings
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.chain import fibre_in_world, optical_axis
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.simulator.optics import RecorderSettings
from fpcal_bayes.simulator.recorder import record_sweeps

DEG = np.pi / 180.0
#: Tilts about either axis at four nodes.
TILTS = np.array([0, 1, 9, 10, 18, 19, 27, 28])


@pytest.fixture(scope="module")
def cell(femto: Cell) -> Cell:
    return femto.with_opd("perpendicular")


@pytest.fixture(scope="module")
def tilts(cell: Cell) -> Sweeps:
    rows = tilting(cell, paper_protocol(cell))
    return paper_protocol(cell).take(rows[TILTS])


@pytest.fixture(scope="module")
def index(cell: Cell, tilts: Sweeps) -> TraceIndex:
    return record_sweeps(cell, paper_truth(cell), tilts, seed=3, scans=False)


@pytest.fixture(scope="module")
def found(cell: Cell, index: TraceIndex) -> Ingested:
    return ingest(index, cell)


def far_field(cell: Cell, values: np.ndarray, sweeps: Sweeps, radius: float) -> np.ndarray:
    """Slopes and bows (n, 2) of -2 angle^2 / divergence^2 - log distance, the far field of a Gaussian beam."""
    model, s = CavityModel.of(cell), np.linspace(-1.0, 1.0, 41)
    vector = model.vector(values)
    fibre, axis = fibre_in_world(vector)[:3, 3], optical_axis(cell, vector)
    shapes = []
    for start, end in zip(sweeps.q_start, sweeps.q_end, strict=True):
        normals, origins = model.mirrors(values, start + 0.5 * (1.0 + s[:, None]) * (end - start))
        sine = np.linalg.norm(np.cross(normals, axis), axis=1)
        away = np.abs(((origins - fibre) * normals).sum(axis=1))
        divergence = cell.wavelength / (np.pi * radius)
        shapes.append(np.polynomial.legendre.legfit(s, -2.0 * (sine / divergence) ** 2 - np.log(away), 4)[1:3])
    return np.array(shapes)


def noisy(shape: np.ndarray, sweeps: Sweeps, sd: float, seed: int) -> Amplitudes:
    """Amplitudes with a noise that the traces know of."""
    covariance = np.tile(sd**2 * np.eye(2), (len(shape), 1, 1))
    return Amplitudes(sweeps, shape + sd * np.random.default_rng(seed).standard_normal(shape.shape), covariance)


def errors(found: Estimate, values: np.ndarray, names: tuple[str, ...] = DIRECTION) -> np.ndarray:
    at, full = found.parameters.positions(names), found.cell.free.positions(names)
    return (found.values[at] - values[full]) / found.sd[at]


def near(cell: Cell, values: np.ndarray) -> Estimate:
    """An estimate that knows the mirror to 1e-4 of its priors, and of the fibre's direction nothing."""
    sds = 1e-4 * np.array([p.prior_sd for p in cell.free])
    start = values.copy()
    at = cell.free.positions(DIRECTION)
    start[at], sds[at] = 0.0, DEG
    return Estimate(cell, cell.free, start, np.diag(sds**2), ("weak",) * len(sds))


def test_the_joints_that_tilt_the_mirror_are_found(cell: Cell) -> None:
    plan = paper_protocol(cell)
    chosen = plan.take(tilting(cell, plan))
    moved = (chosen.q_start != chosen.q_end).any(axis=0)
    assert len(chosen) == 30
    assert moved.tolist() == [False, False, False, True, True, False]


def test_the_direction_by_a_closed_form(cell: Cell, tilts: Sweeps) -> None:
    values = cell.free.nominal.copy()
    values[cell.free.positions(DIRECTION)] = [0.8 * DEG, -0.5 * DEG]
    found = align(cell, noisy(far_field(cell, values, tilts, 5.0), tilts, 2e-3, 1), near(cell, values))
    # One sweep of +-3 deg: slope 4 angle half / divergence^2.
    divergence = cell.wavelength / (np.pi * 5.0)
    expected = 2e-3 * divergence**2 / (4.0 * 3.0 * DEG) / 2.0
    sds = np.sqrt(np.diag(found.noise))
    assert 0.8 * expected < sds.min() <= sds.max() < 2.0 * expected
    assert np.abs((found.direction / DEG - [0.8, -0.5]) * DEG / sds).max() < 3.0
    assert found.mode_field_radius == pytest.approx(5.0, abs=4.0 * found.mode_field_radius_sd)
    assert np.abs(errors(found.estimate, values)).max() < 3.0


def test_the_datum_is_an_angle_between_mirror_and_fibre(cell: Cell, tilts: Sweeps) -> None:
    values = cell.free.nominal
    found = align(cell, noisy(far_field(cell, values, tilts, 5.2), tilts, 2e-3, 2))
    # Held, the fibre is known to millidegrees; with the mirror's priors, hardly better than before.
    assert np.sqrt(np.diag(found.noise)).max() < 0.01 * DEG
    assert np.sqrt(np.diag(found.covariance)).min() > DEG
    narrowed = found.estimate.sd[found.estimate.parameters.positions(DIRECTION)]
    assert ((narrowed > 0.6 * DEG) & (narrowed < DEG)).all()
    prior = prior_sds(cell)
    shares, vectors = np.linalg.eigh(found.estimate.covariance / np.outer(prior, prior))
    assert (shares[:2] < 0.01).all()
    seen = np.abs(vectors[:, :2]).max(axis=1)
    assert (seen[cell.free.positions([*DIRECTION, "beta_et", "theta_et"])] > 0.1).all()


def prior_sds(cell: Cell) -> np.ndarray:
    return np.array([p.prior_sd for p in cell.free])


def test_truths_drawn_from_the_prior_are_within_the_datum(cell: Cell, tilts: Sweeps) -> None:
    random, squares = np.random.default_rng(8), []
    for k in range(4):
        values = cell.free.nominal + prior_sds(cell) * random.standard_normal(len(cell.free))
        found = align(cell, noisy(far_field(cell, values, tilts, 5.3), tilts, 3e-3, k)).estimate
        off = found.values - values
        squares.append(off @ np.linalg.solve(found.covariance, off))
    # Chi-square of 84 within 99.9 %.
    assert 50.0 < sum(squares) < 132.0


def test_an_estimate_only_says_where_to_be_linear(cell: Cell, tilts: Sweeps) -> None:
    values = cell.free.nominal + 0.5 * prior_sds(cell) * np.random.default_rng(4).standard_normal(len(cell.free))
    amplitudes = noisy(far_field(cell, values, tilts, 5.2), tilts, 2e-3, 3)
    alone, led = align(cell, amplitudes), align(cell, amplitudes, near(cell, values))
    assert led.nonlinear < 1e-3 < alone.nonlinear
    # Its certainty of the mirror is not in the datum.
    at = cell.free.positions(["beta_et", "theta_et"])
    assert (led.estimate.sd[at] > 0.6 * prior_sds(cell)[at]).all()
    # Nor is its certainty of a direction that is none any more.
    stale = near(cell, values)
    stale = align(cell, amplitudes, replace(stale, covariance=np.diag((1e-4 * prior_sds(cell)) ** 2))).estimate
    assert np.abs((stale.values - led.estimate.values) / led.estimate.sd).max() < 0.1
    np.testing.assert_allclose(stale.sd, led.estimate.sd, rtol=0.05)


def test_traces_give_the_direction(cell: Cell, tilts: Sweeps, found: Ingested) -> None:
    truth = paper_truth(cell)
    model = CavityModel.of(cell, truth.parameters)
    values = cell.free.nominal.copy()
    values[cell.free.positions(model.free.names)] = truth.at(0.0)
    amplitudes = fringe_amplitudes(cell, tilts, found)
    expected = far_field(cell, values, tilts, cell.interferometer.mode_field_radius)
    # The rig's gain changes by one per cent along a trace, a quarter of which a slope or bow takes at most.
    assert np.abs(amplitudes.shape - expected).max() < 0.008
    assert (np.linalg.eigvalsh(amplitudes.covariance) > 0.0).all()
    aligned = align(cell, amplitudes, near(cell, values))
    assert aligned.n_sweeps == 8
    assert aligned.probability > 1e-3
    assert np.abs(errors(aligned.estimate, values)).max() < 3.0
    assert np.sqrt(np.diag(aligned.noise)).max() < 0.02 * DEG


def test_what_the_datum_cannot_be_made_of(cell: Cell, tilts: Sweeps, found: Ingested) -> None:
    with pytest.raises(InputError, match="3 sweeps that tilt the mirror can be used, expected 4 or more"):
        fringe_amplitudes(cell, tilts, replace(found, readings=(None,) * 5 + found.readings[5:]))
    one = replace(found, readings=tuple(np.where(tilts.q_start[:, 3] != 0.0, found.readings, None)))
    with pytest.raises(InputError, match="tilt the mirror about one axis"):
        fringe_amplitudes(cell, tilts, one)
    flat = Amplitudes(tilts, np.zeros((8, 2)), np.tile(1e-6 * np.eye(2), (8, 1, 1)))
    with pytest.raises(InputError, match="do not follow the coupling of mirror and fibre"):
        align(cell, flat)


def test_a_gain_that_drifts_widens_the_noise(cell: Cell, tilts: Sweeps) -> None:
    shape, random = far_field(cell, cell.free.nominal, tilts, 5.2), np.random.default_rng(6)
    small = np.tile(1e-6 * np.eye(2), (8, 1, 1))
    calm = align(cell, Amplitudes(tilts, shape, small))
    lively = align(cell, Amplitudes(tilts, shape + 0.02 * random.standard_normal(shape.shape), small))
    assert calm.drift.max() < 1e-3
    assert ((lively.drift > 0.01) & (lively.drift < 0.05)).all()
    assert np.diag(lively.noise).min() > 50.0 * np.diag(calm.noise).max()
    few = align(cell, Amplitudes(tilts.take(np.arange(4)), shape[:4], small[:4]))
    assert few.drift.tolist() == [0.2, 0.12]


def test_the_command_writes_a_prior(tmp_path: Path, cell: Cell, index: TraceIndex, capsys) -> None:
    write_recordings(tmp_path / "index.h5", index, cell)
    out, datum, result = (tmp_path / name for name in ("sweeps.csv", "datum.json", "result.json"))
    settings = ["--opd", "perpendicular"]
    read = ["ingest", str(tmp_path / "index.h5"), "-o", str(out), *settings]
    assert main([*read, "--alignment", str(datum)]) == 0
    assert "fringe amplitude along 8 sweeps tells, the mirror held, beta_wf to 0.0" in capsys.readouterr().out
    content = json.loads(datum.read_text())
    assert content["alignment"]["n_sweeps"] == 8
    assert content["data"]["file"] == "index.h5"
    assert read_estimate(datum, cell).parameters.names == cell.free.names
    assert main(["identify", str(out), *settings, "--prior", str(datum), "--json", str(result)]) == 0
    assert main(["ingest", str(tmp_path / "index.h5"), "-o", str(out), *settings, "--alignment", str(out)]) == 2
    assert "is another output too" in capsys.readouterr().err


def test_a_refusal_writes_nothing(tmp_path: Path, cell: Cell, tilts: Sweeps, capsys) -> None:
    settings = RecorderSettings(fading=False)
    write_recordings(tmp_path / "i.h5", record_sweeps(cell, paper_truth(cell), tilts, settings, scans=False), cell)
    before = sorted(tmp_path.iterdir())
    command = ["ingest", str(tmp_path / "i.h5"), "-o", str(tmp_path / "o.csv"), "--opd", "perpendicular"]
    assert main([*command, "--alignment", str(tmp_path / "a.json")]) == 2
    assert "do not follow the coupling of mirror and fibre" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before
