"""Gauges bend: what that adds to a parameter's standard deviation where its slope on them vanishes."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fpcal_bayes.core.files import write_json
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.minimise import curve_sd, minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA
from fpcal_bayes.simulator.sweeps import simulate_um


def flat_truth(cell: Cell, random: np.random.Generator) -> Truth:
    """A truth from the prior whose estimate, which has theta_6 at zero, has next to no slope of theta_et on theta_6."""
    values = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
    turn, side, tilt = cell.free.positions(["theta_6", "beta_et", "theta_et"])
    values[side] = random.uniform(-5e-5, 5e-5) + values[turn] * values[tilt]
    return replace(paper_truth(cell), times_h=np.zeros(1), values=values[None])


def test_a_slope_that_vanishes_is_covered_and_no_length_feels_the_bend(femto: Cell) -> None:
    random, plan, model = np.random.default_rng(4), paper_protocol(femto, midpoints=True), CavityModel.of(femto)
    tilt, squares = femto.free.position("theta_et"), []
    for seed in range(80):
        truth = flat_truth(femto, random)
        problem = Problem.of(model, simulate_um(femto, truth, plan, sigma=1e-4, seed=seed))
        found = minimise(problem, problem.unknowns(truth.values[0])).unknowns
        covariance, error = problem.covariance(found), problem.values(found) - truth.values[0]
        bend, sd = curve_sd(problem, found, covariance), np.sqrt(np.diag(covariance))
        # The lengths are as near as the covariance, without the bend, says.
        lengths, slopes = model.predict_with_jacobian(problem.values(found), problem.rows)
        off = lengths - model.predict(truth.values[0], problem.rows)
        known = np.sqrt(np.einsum("ki,ij,kj->k", slopes, covariance, slopes))
        squares.append(
            (*(error[tilt] / np.array([sd[tilt], np.hypot(sd, bend)[tilt]])) ** 2, np.mean((off / known) ** 2))
        )
    first, covered, of_lengths = np.mean(squares, axis=0)
    assert first > 10.0
    assert 0.5 < covered < 1.6
    assert 0.8 < of_lengths < 1.2


def test_an_estimate_keeps_the_bend_in_its_file(femto: Cell, tmp_path: Path) -> None:
    truth = flat_truth(femto, np.random.default_rng(4))
    result = identify(femto, simulate_um(femto, truth, paper_protocol(femto, midpoints=True), sigma=1e-4, seed=0))
    made, content = result.estimate, {"schema": SCHEMA, "command": "identify", **result.content()}
    assert made["theta_et"]["sd"] > 2.0 * np.degrees(
        np.sqrt(np.diag(made.covariance)[made.parameters.position("theta_et")])
    )
    assert made["theta_et"]["curve_sd"] > 0.0
    assert "curve_sd" not in made["theta_2"]
    write_json(tmp_path / "estimate.json", content)
    again = read_estimate(tmp_path / "estimate.json", femto)
    np.testing.assert_allclose(again.sd, made.sd, rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(again.covariance, made.covariance, rtol=1e-9, atol=1e-16)
