from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.priors import LogNormal, TruncatedNormal, Uniform
from fpcal_bayes.simulator.sweeps import simulate_um

DEG = np.pi / 180


def with_priors(cell: Cell, priors: dict) -> Cell:
    """The cell with some priors that are not normal."""
    parameters = ParameterSet(
        replace(p, prior=priors[p.name], prior_sd=priors[p.name].sd) if p.name in priors else p for p in cell.parameters
    )
    return replace(cell, parameters=parameters)


MIXED = {
    "beta_wf": Uniform(-2.0 * DEG, 1.0 * DEG),
    "z_et": TruncatedNormal(0.0, 20.0, -5.0, 30.0),
    "y_wf": LogNormal(920.0, 1.2),
    "theta_et": TruncatedNormal(0.0, 1.0 * DEG, 0.0, np.inf),
}


@pytest.fixture(scope="module")
def mixed() -> Cell:
    return with_priors(load_cell(mechanics="none"), MIXED)


@pytest.fixture(scope="module")
def day_0() -> tuple:
    cell = load_cell(mechanics="none")
    sweeps = simulate_um(cell, paper_truth(cell), paper_protocol(cell), sigma=0.005, seed=3)
    return cell, sweeps, identify(cell, sweeps)


def numerical_slopes(prior: Prior, scores: np.ndarray) -> np.ndarray:
    step = 1e-6
    shifts = step * np.eye(len(scores))
    return (prior.values(scores + shifts) - prior.values(scores - shifts)).T / (2 * step)


def test_independent_priors(mixed):
    prior = Prior.of(mixed.free)
    random = np.random.default_rng(0)
    scores = random.standard_normal((5, len(mixed.free)))
    values = prior.values(scores)
    for name in ("alpha_2", "x_wf"):
        i = mixed.free.position(name)
        p = mixed.free[name]
        np.testing.assert_allclose(values[:, i], p.nominal + p.prior_sd * scores[:, i])
    for name, marginal in MIXED.items():
        i = mixed.free.position(name)
        np.testing.assert_allclose(values[:, i], marginal.value(scores[:, i]))
    np.testing.assert_allclose(prior.scores(values[2]), scores[2], atol=1e-9)
    np.testing.assert_allclose(prior.slopes(scores[1]), numerical_slopes(prior, scores[1]), rtol=1e-6, atol=1e-9)


def test_joint_prior_has_the_estimates_mean_and_covariance(day_0, mixed):
    _, _, found = day_0
    prior = Prior.joint(mixed.free, found.estimate)
    np.testing.assert_allclose(prior.values(np.zeros(21)), found.estimate.values)
    scale = found.estimate.sd
    product = prior.factor @ prior.factor.T
    np.testing.assert_allclose(
        product / np.outer(scale, scale), found.estimate.covariance / np.outer(scale, scale), atol=1e-9
    )
    scores = np.random.default_rng(1).standard_normal(21)
    np.testing.assert_allclose(prior.scores(prior.values(scores)), scores, atol=1e-4)
    # A linear map: differences of whole scores are exact but for rounding.
    ahead = prior.values(scores + np.eye(21)) - prior.values(scores)
    np.testing.assert_allclose(prior.slopes(scores).T / scale, ahead / scale, atol=1e-7)


def test_joint_prior_leaves_other_parameters_alone(day_0, mixed):
    cell, sweeps, _ = day_0
    extrinsic = identify(cell, sweeps, free="extrinsic", hold="exact").estimate
    prior = Prior.joint(mixed.free, extrinsic)
    own = Prior.of(mixed.free)
    intrinsic = [i for i, p in enumerate(mixed.free) if p.kind == "intrinsic"]
    np.testing.assert_array_equal(prior.mean[intrinsic], own.mean[intrinsic])
    np.testing.assert_allclose(np.diag(prior.factor)[intrinsic], own.sd[intrinsic])
    assert prior.others == ()
    assert Prior.joint(mixed.free[:13], extrinsic).factor is None


class TestIdentification:
    def test_two_halves_in_turn_are_as_good_as_both_at_once(self, day_0):
        """Yesterday's posterior as today's prior: information adds up where the model is nearly linear."""
        cell, sweeps, _ = day_0
        settings = {"free": "x_wf,z_wf,z_et,beta_wf", "hold": "exact"}
        truth = identify(cell, sweeps).estimate
        chosen = np.arange(len(sweeps)) % 2 == 0
        whole = identify(cell, sweeps, start=truth, **settings).estimate
        first = identify(cell, sweeps.take(chosen), start=truth, **settings).estimate
        second = identify(cell, sweeps.take(~chosen), start=truth, prior=first, **settings).estimate
        names = settings["free"].split(",")
        (values, covariance), (expected, expected_covariance) = second.block(names), whole.block(names)
        sd = np.sqrt(np.diag(expected_covariance))
        assert (np.abs(values - expected) < 0.05 * sd).all()
        assert (np.abs(first.block(names)[0] - expected) > 0.1 * sd).any()
        np.testing.assert_allclose(covariance / np.outer(sd, sd), expected_covariance / np.outer(sd, sd), atol=0.02)

    def test_prior_alone_decides_where_the_data_are_silent(self, mixed):
        """y_wf is a gauge of the axis path, but for the small tilt of the axis: prior's median and spread stay."""
        sweeps = simulate_um(mixed, paper_truth(mixed), paper_protocol(mixed), sigma=0.005, seed=3)
        found = identify(mixed, sweeps)
        i = mixed.free.position("y_wf")
        assert found.estimate.values[i] == pytest.approx(920.0, rel=0.005)
        assert found.estimate.sd[i] == pytest.approx(mixed.free.prior_sd[i], rel=0.01)
        assert found.estimate.status[i] == "gauge"
        assert found.estimate.values[mixed.free.position("theta_et")] > 0


@pytest.mark.slow
@pytest.mark.parametrize("names", [("beta_wf", "z_et"), ("y_wf", "theta_et")])
def test_draws_have_the_moments_of_a_grid(mixed, names):
    """Two free parameters, noise so large that the priors count: against integration over the prior's own density."""
    chosen = mixed.select(names)
    sigma = 3.0
    sweeps = simulate_um(mixed, paper_truth(mixed), paper_protocol(mixed), sigma=sigma, seed=5)
    found = identify(mixed, sweeps, free=names, hold="exact")
    posterior = sample(found, draws=4000, seed=1)
    assert posterior.converged
    draws = posterior.values().reshape(-1, 2)

    known = {
        "beta_wf": stats.uniform(-2.0 * DEG, 3.0 * DEG),
        "z_et": stats.truncnorm(-0.25, 1.5, 0.0, 20.0),
        "y_wf": stats.lognorm(np.log(1.2), scale=920.0),
        "theta_et": stats.halfnorm(0.0, 1.0 * DEG),
    }
    # Equal shares of the prior.
    axes = [known[p.name].ppf((np.arange(800) + 0.5) / 800) for p in chosen]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    predicted = found.problem.model.predict(grid, found.problem.rows)
    log_density = -0.5 * (((predicted - sweeps.dl) / sigma) ** 2).sum(axis=1)
    weight = np.exp(log_density - log_density.max())
    weight /= weight.sum()
    mean = weight @ grid
    sd = np.sqrt(weight @ (grid - mean) ** 2)
    assert (np.abs(draws.mean(axis=0) - mean) < 0.08 * sd).all()
    np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.05)
