"""Student-t rows, against sums over a grid of the densities that scipy has."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.student import DOF, StudentProblem, StudentTangent, bend, log_peak, robust_minimum
from fpcal_bayes.infer.posterior.draws import make_target
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
NAMES = ("beta_wf", "x_wf")
OUTLIERS = {3: 4.0, 17: -2.5, 40: 9.0, 60: 30.0}


@pytest.fixture(scope="module")
def case():
    """Two free parameters and a few outliers."""
    clean = simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL), sigma=0.3, seed=1)
    known = identify(CELL, clean).estimate
    dl = clean.dl.copy()
    for row, size in OUTLIERS.items():
        dl[row] += size
    sweeps = replace(clean, dl=dl)
    return sweeps, identify(CELL, sweeps, free=NAMES, start=known, hold="exact")


def test_student_draws(case):
    """Mean and sd are those of a sum over a grid around where the draws lie."""
    _, found = case
    problem = found.problem
    axes = [np.linspace(-12.0, 12.0, 81) * sd for sd in found.estimate.sd[found.estimate.sd > 0]]
    best = robust_minimum(StudentProblem.like(problem, DOF), found.solution.unknowns)
    shifts = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    values = problem.values(best.unknowns) + shifts
    standardised = (problem.model.predict(values, problem.rows) - problem.target) / problem.sweeps.sigma
    log_density = stats.norm.logpdf(values, CELL.select(NAMES).nominal, CELL.select(NAMES).prior_sd).sum(axis=1)
    log_density += stats.t.logpdf(standardised, DOF).sum(axis=1)
    weight = special.softmax(log_density)
    mean = weight @ values
    posterior = sample(found, draws=4000, likelihood="student", seed=2)
    draws, sd = posterior.values().reshape(-1, 2), np.sqrt(weight @ (values - mean) ** 2)
    assert posterior.converged
    assert (np.abs(draws.mean(axis=0) - mean) < 0.08 * sd).all()
    np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.05)


class TestStudent:
    def test_bent_residual_has_the_log_density_of_scipy(self):
        s = np.concatenate([-np.geomspace(1e-9, 1e4, 50), [0.0], np.geomspace(1e-9, 1e4, 50)])
        bent, slope = bend(s, DOF)
        np.testing.assert_allclose(log_peak(DOF) - 0.5 * bent**2, stats.t.logpdf(s, DOF), rtol=1e-10)
        assert (slope > 0).all()
        inner = np.abs(s) < 1e3
        step = 1e-5 * np.maximum(np.abs(s), 1e-3)
        numerical = (bend(s + step, DOF)[0] - bend(s - step, DOF)[0]) / (2 * step)
        np.testing.assert_allclose(slope[inner], numerical[inner], rtol=1e-5)

    def test_tangent_has_the_slope_of_the_log_density(self):
        s = np.linspace(-8.0, 8.0, 33)
        tangent = StudentTangent.at(s, DOF)
        step = 1e-5
        slope = (stats.t.logpdf(s + step, DOF) - stats.t.logpdf(s - step, DOF)) / (2 * step)
        np.testing.assert_allclose(-tangent.rows(s) * tangent.gain, slope, atol=1e-8)
        np.testing.assert_allclose(tangent.standardised(tangent.rows(s + 0.3)), s + 0.3)

    def test_outliers_hardly_pull(self):
        clean = simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL), sigma=0.005, seed=1)
        best = identify(CELL, clean)
        dl = clean.dl.copy()
        for row, size in OUTLIERS.items():
            dl[row] += 0.1 * size
        spoilt = identify(CELL, replace(clean, dl=dl))
        robust = robust_minimum(StudentProblem.like(spoilt.problem, DOF), spoilt.solution.unknowns)
        assert robust.converged
        residuals = StudentProblem.like(spoilt.problem, DOF).model.predict(
            spoilt.problem.values(robust.unknowns), spoilt.problem.rows
        )
        apart = (residuals - best.problem.model.predict(best.estimate.values, best.problem.rows)) / 0.005
        kept = np.setdiff1d(np.arange(69), list(OUTLIERS))
        assert np.sqrt(np.mean(apart[kept] ** 2)) < 0.5


@pytest.mark.parametrize("likelihood", ["gaussian", "student", "slip"])
def test_rows_and_prior_make_up_the_density(case, likelihood):
    """The density that is sampled is the product of the rows' likelihoods and the prior, also as a chart sees it."""
    _, found = case
    target, references = make_target(found, likelihood)
    points = references[0] + 0.3 * np.random.default_rng(0).standard_normal((20, target.n_unknowns)) / 100
    expected = target.log_likelihoods(points).sum(axis=1) + stats.norm.logpdf(points).sum(axis=1)
    for seen in (target, target.centred(references[0]), target.centred(points[3])):
        found_density = seen.log_density(seen.data_residuals(points), points)
        np.testing.assert_allclose(found_density - found_density[0], expected - expected[0], atol=1e-6)
        residuals, _ = seen.data_batch(points)
        np.testing.assert_allclose(residuals, seen.data_residuals(points), atol=1e-9)


def test_drawn_errors_have_the_scatter_of_the_likelihood(case):
    _, found = case
    target, references = make_target(found, "student")
    points = np.repeat(references[:1], 4000, axis=0)
    errors = target.draw_noise(points, np.random.default_rng(0))
    assert stats.kstest(errors.ravel()[::7], stats.t(DOF).cdf).pvalue > 0.001
    slipped, references = make_target(found, "slip")
    errors = slipped.draw_noise(np.repeat(references[:1], 4000, axis=0), np.random.default_rng(0))
    eps = special.expit(-3.0 + 1.2 * references[0, -1])
    half_wave = 0.5 * CELL.wavelength / 0.3
    # Counts from 1 to 3 have a mean square of 14 / 3.
    assert np.mean(errors**2) == pytest.approx(1.0 + eps * 14.0 / 3.0 * half_wave**2, rel=0.05)
