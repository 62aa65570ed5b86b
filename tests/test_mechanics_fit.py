"""The geometry of a machine, fitted with its mechanics marginalised; errors along tasks; the exact posterior."""

from dataclasses import replace

import numpy as np
import pytest
from machine_errors import mechanics_task_errors
from scipy import linalg, stats

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.minimise import minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.mechanics.fit import fit_mechanics
from fpcal_bayes.infer.mechanics.judge import doubts_of, term_tests
from fpcal_bayes.infer.mechanics.known import covariance_of
from fpcal_bayes.infer.mechanics.posterior import ScaleCharts
from fpcal_bayes.infer.mechanics.rows import RowNoise, scaled_whitening
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.tasks.source import PATH_POINTS
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import protocol_by_name
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics import JointMechanics, Mechanics, Terms, design
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.simulator.machine import Machine, MachineSettings

STAGE = JointMechanics(straightness_nm=30, pitch_urad=2, yaw_urad=2, linearity=45, reversal=10, return_sd=2)
TURN = JointMechanics(
    radial_runout_nm=100, axial_runout_nm=100, wobble_urad=15, linearity=26, reversal=1, return_sd=1, encoder=0.5
)
SIZES = Mechanics((STAGE, STAGE, STAGE, TURN, TURN, TURN), drift_nm_per_min=3.0)
SIGMA = 0.005


@pytest.fixture(scope="module")
def cell():
    return load_cell(mechanics="none")


def _machine(cell, seed, sizes=SIZES):
    rng, truth = np.random.default_rng(seed), paper_truth(cell)
    vector = cell.parameters.nominal.copy()
    vector[truth.parameters.slots] = truth.at(0.0)
    return Machine.draw(cell, sizes, vector, rng)


def _problem(cell, machine, plan="paper-mid"):
    plan = protocol_by_name(plan, cell)
    measured = plan.with_measurement(machine.sweep(drive_of_sweeps(plan, 1.0), SIGMA), SIGMA)
    return Problem.of(CavityModel.of(cell), measured)


@pytest.fixture(scope="module")
def fitted(cell):
    machine = _machine(cell, 1)
    return machine, fit_mechanics(_problem(cell, machine), SIZES)


def _dense(fit, log):
    """The rows' covariance, written out."""
    factors = np.exp(log)
    readings, returns = fit.noise.dense()
    columns = fit.design.matrix * factors[fit.design.scale]
    return columns @ columns.T + factors[-1] ** 2 * readings + factors[-2] ** 2 * returns


def test_whitening_is_the_inverse_root_of_the_covariance(fitted):
    _, fit = fitted
    log = np.linspace(-0.5, 0.5, len(fit.terms.scales))
    whitening, covariance = scaled_whitening(fit.noise, fit.design, log), _dense(fit, log)
    n = len(covariance)
    root = whitening.apply(np.eye(n))
    np.testing.assert_allclose(root @ covariance @ root.T, np.eye(n), atol=2e-6)
    vector = np.random.default_rng(0).standard_normal(n) * SIGMA
    np.testing.assert_allclose(whitening.weigh(vector), np.linalg.solve(covariance, vector), rtol=1e-6, atol=1e-4)


def test_row_noise_by_draws(cell):
    machine = _machine(cell, 2)
    problem = _problem(cell, machine)
    made = design(Terms.of(cell, SIZES), machine.vector, drive_of_sweeps(problem.sweeps, 1.0), problem.sweeps.sigma)
    noise = RowNoise.of(problem.sweeps, made)
    drawn = noise.draw(np.full(4000, 1.3), np.full(4000, 0.7), np.random.default_rng(0))
    readings, returns = noise.dense()
    expected = 1.3**2 * readings + 0.7**2 * returns
    spread = drawn.T @ drawn / len(drawn)
    assert np.abs(spread - expected).max() < 0.1 * expected.max()


def test_density_of_scales_by_differences(fitted):
    _, fit = fitted
    log = np.random.default_rng(1).normal(0.0, 0.4, len(fit.terms.scales))
    _, slope = fit.density.value_and_slope(log)
    for k in range(len(log)):
        step = np.zeros(len(log))
        step[k] = 3e-3
        difference = (fit.density.value(log + step) - fit.density.value(log - step)) / 6e-3
        assert slope[k] == pytest.approx(difference, rel=1e-3, abs=1e-3)


def test_draws_are_the_conditional_normal(fitted):
    _, fit = fitted
    mean, covariance = fit.moments()
    drawn, sd = fit.draws.scores, np.sqrt(np.diag(covariance))
    assert np.abs((drawn.mean(axis=0) - mean) / sd).max() < 0.12
    assert np.abs(np.log(drawn.std(axis=0) / sd)).max() < 0.12


def test_held_parameters_keep_their_covariance(cell):
    machine = _machine(cell, 9)
    plan = protocol_by_name("paper-mid", cell)
    measured = plan.with_measurement(machine.sweep(drive_of_sweeps(plan, 1.0), SIGMA), SIGMA)
    extrinsic = [name for name in cell.free.names if name.endswith(("_et", "_wf"))]
    real = replace(cell, mechanics=SIZES)
    known = Estimate(real, real.free, real.free.nominal, np.diag(real.free.prior_sd**2), ("weak",) * len(real.free))
    found = identify(real, measured, free=extrinsic, start=known)
    fit, n = found.machine, len(extrinsic)
    covariance = covariance_of(fit)
    held = fit.problem.considered.parameters
    np.testing.assert_allclose(covariance[n:, n:], np.diag(held.prior_sd**2), atol=1e-12)
    # Schmidt's at the typical scales, by the problem's own way, differs by the spread of the scales only.
    sd = np.sqrt(np.diag(covariance))
    # Schmidt's update written out (Joseph's form, which holds for any gain), over the mixture of scales.
    rows, centres, spread = fit.rows.geometry, [], np.zeros((len(sd), len(sd)))
    for log in fit.scales.log:
        noise, gain = _dense(fit, log), np.zeros(rows.T.shape)
        gain[:n] = np.linalg.solve(noise + rows @ rows.T, rows[:, :n]).T
        left = np.eye(len(sd)) - gain @ rows
        spread += (left @ left.T + gain @ noise @ gain.T) / len(fit.scales.log)
        centres.append(gain @ fit.rows.target)
    scale = linalg.block_diag(fit.problem.prior.slopes(fit.solution.unknowns[:n]), fit.problem.considered.factor)
    expected = scale @ (spread + np.cov(np.array(centres).T, bias=True)) @ scale.T
    np.testing.assert_allclose(covariance / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-6)
    # What is handed on draws the same.
    slopes = fit.problem.prior.slopes(fit.solution.unknowns[:n])
    drawn = np.hstack([fit.draws.scores[:, :n] @ slopes.T, fit.draws.scores[:, n:] @ fit.problem.considered.factor.T])
    assert np.abs((np.cov(drawn.T) - covariance) / np.outer(sd, sd)).max() < 0.15


def test_bands_hold_where_white_noise_does_not(cell, fitted):
    machine, fit = fitted
    assert fit.solution.converged
    inside, promised = [], []
    for name in ("circle", "line-x", "line-z", "tilt-z"):
        task = task_path(cell, fit.problem.model.vector(fit.values), name, n_points=PATH_POINTS)
        rows = fit.problem.model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)
        error = machine.path(task.start, task.q, 69.0) - fit.problem.model.predict(fit.values, rows)
        drawn = mechanics_task_errors(fit, task)
        low, high = np.quantile(np.ptp(drawn.total, axis=1), [0.025, 0.975])
        inside.append(low <= np.ptp(error) <= high)
        promised.append(high)
        assert drawn.returned.any()
    assert all(inside)
    # The ideal model promises a nanometre or two.
    assert min(promised) > 0.02


def test_scales_that_no_row_sees_keep_their_prior(cell):
    # End points of sweeps by one joint: nothing tells the tilts of a stage without a lever.
    machine = _machine(cell, 3, SIZES.scaled(0.0))
    fit = fit_mechanics(_problem(cell, machine, "paper"), SIZES)
    tilt = fit.scales.log[:, fit.terms.scales.index("stage, tilt")]
    assert abs(np.median(tilt)) < 0.4
    assert 0.8 < tilt.std() / np.log(3.0) < 1.2


def test_compressed_rows_tell_the_same(cell, fitted, monkeypatch):
    machine, _ = fitted
    sizes = replace(SIZES, joints=tuple(replace(joint, return_sd=0.0, encoder=0.0) for joint in SIZES.joints))
    problem = _problem(cell, machine)
    whole = fit_mechanics(problem, sizes)
    monkeypatch.setattr("fpcal_bayes.infer.mechanics.fit.DENSE_ROWS", 0)
    compressed = fit_mechanics(problem, sizes)
    log = np.random.default_rng(2).normal(0.0, 0.3, len(whole.terms.scales))
    shift = [fit.density.value(log) - fit.density.value(0.5 * log) for fit in (whole, compressed)]
    assert shift[1] == pytest.approx(shift[0], abs=1e-3)
    np.testing.assert_allclose(compressed.solution.unknowns, whole.solution.unknowns, atol=0.15)


def test_density_of_scales_is_that_of_the_rows(fitted):
    _, fit = fitted
    logs = np.random.default_rng(3).normal(0.0, 0.4, (3, len(fit.terms.scales)))
    expected = []
    for log in logs:
        covariance = _dense(fit, log) + fit.rows.geometry @ fit.rows.geometry.T
        rows = stats.multivariate_normal.logpdf(fit.rows.target, cov=covariance, allow_singular=True)
        expected.append(rows + stats.norm.logpdf(log, scale=fit.density.prior_sd).sum())
    values = [value for value, _ in fit.density.at(logs)]
    np.testing.assert_allclose(np.diff(values), np.diff(expected), atol=1e-4)
    for log, (_, lower) in zip(logs, fit.density.at(logs), strict=True):
        np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(_dense(fit, log)), rtol=0, atol=1e-10)


def test_draws_are_weighed_by_the_density_over_the_proposal(fitted):
    # At one set of scales, by densities written out; the determinant by differences of the map.
    _, fit = fitted
    covariance, problem = _dense(fit, fit.scales.log[0]), fit.problem
    charts = ScaleCharts(problem, fit.solution.unknowns, [np.linalg.cholesky(covariance)] * 3)
    normal = np.random.default_rng(4).standard_normal((3, problem.n_unknowns))
    points, log_density, log_proposal = charts.solve(normal)
    for k, (point, e) in enumerate(zip(points, normal, strict=True)):
        miss = problem.model.predict(problem.values(point), problem.rows) - problem.target
        density = -0.5 * miss @ np.linalg.solve(covariance, miss) - 0.5 * point @ point
        assert log_density[k] == pytest.approx(density - 0.5 * np.linalg.slogdet(covariance)[1], abs=1e-6)

        def h(v):
            rows = problem.model.predict(problem.values(v), problem.rows) - problem.target
            return charts.on_data[0] @ rows + charts.on_prior[0] @ v

        np.testing.assert_allclose(h(point), e, atol=1e-6)
        steps = 1e-5 * np.eye(len(point))
        slopes = np.array([(h(point + step) - h(point - step)) / 2e-5 for step in steps]).T
        assert log_proposal[k] == pytest.approx(np.linalg.slogdet(slopes)[1] - 0.5 * e @ e, abs=1e-3)
    np.testing.assert_allclose(charts.log_proposal(points), log_proposal, atol=1e-5)
    np.testing.assert_allclose(charts.log_density(points), log_density, atol=1e-9)


def test_sampler_agrees_with_a_plain_random_walk(cell):
    # Few parameters, rows and scales: a random walk on the density, written out, with no chart and no linearisation.
    stage = JointMechanics(straightness_nm=60, reversal=20, return_sd=4)
    sizes = Mechanics((stage, stage, stage, *[JointMechanics()] * 3), correlated_nm=0.0)
    plan = protocol_by_name("paper", cell)
    plan = plan.take(np.r_[0:8, 45:60])
    machine = _machine(cell, 8, sizes)
    measured = plan.with_measurement(machine.sweep(drive_of_sweeps(plan, 1.0), SIGMA), SIGMA)
    found = identify(replace(cell, mechanics=sizes), measured, free=("theta_wf", "beta_et", "alpha_4"), hold="exact")
    fit, n = found.machine, 3
    drawn = sample(found, draws=3000, seed=1).points.reshape(-1, n + len(fit.terms.scales))

    problem = fit.problem
    readings, returns = fit.noise.dense()

    def density(x):
        scale = np.exp(x[n:])
        columns = fit.design.matrix * scale[fit.design.scale]
        covariance = columns @ columns.T + scale[-1] ** 2 * readings + scale[-2] ** 2 * returns
        miss = problem.model.predict(problem.values(x[:n]), problem.rows) - problem.target
        lower = np.linalg.cholesky(covariance)
        white = np.linalg.solve(lower, miss)
        prior = (x[:n] ** 2).sum() + ((x[n:] / fit.density.prior_sd) ** 2).sum()
        return -0.5 * (white @ white + prior) - np.log(np.diag(lower)).sum()

    rng = np.random.default_rng(5)
    root = 0.7 * np.linalg.cholesky(np.cov(drawn.T))
    at, walked = drawn.mean(axis=0), []
    level = density(at)
    for step, uniform in zip(rng.standard_normal((20_000, len(at))) @ root.T, np.log(rng.random(20_000)), strict=True):
        there = density(at + step)
        if uniform < there - level:
            at, level = at + step, there
        walked.append(at)
    walked = np.array(walked[2000:])
    sd = walked.std(axis=0)
    assert np.abs((drawn.mean(axis=0) - walked.mean(axis=0)) / sd).max() < 0.15
    assert np.abs(np.log(drawn.std(axis=0) / sd)).max() < 0.15
    assert sd[:n].max() > 1e-3


def test_a_motion_beyond_the_sheet_is_named(cell):
    loud = [replace(joint, axial_runout_nm=2500.0) if i == 5 else joint for i, joint in enumerate(SIZES.joints)]
    machine = _machine(cell, 5, replace(SIZES, joints=tuple(loud)))
    fit = fit_mechanics(_problem(cell, machine), SIZES)
    assert any("rotary, along the beam" in doubt.text or "q6" in doubt.text for doubt in doubts_of(fit))


def test_a_return_is_not_blamed_for_a_few_wide_readings(cell):
    gentle = SIZES.scaled(0.2)
    machine = _machine(cell, 26, gentle)
    machine.settings = MachineSettings(student=3.0)
    fit = fit_mechanics(_problem(cell, machine), gentle)
    assert fit.scales.quantiles()[0][-2] > 3.0
    assert doubts_of(fit) == ()
    # A return that spoils all rows is named.
    joints = tuple(replace(joint, return_sd=20.0 * joint.return_sd) for joint in SIZES.joints)
    loud = _machine(cell, 5, replace(SIZES, joints=joints))
    assert any(doubt.text.startswith("return") for doubt in doubts_of(fit_mechanics(_problem(cell, loud), SIZES)))


def test_good_machines_are_not_doubted(fitted):
    _, fit = fitted
    assert doubts_of(fit) == ()
    assert min(p for _, p in term_tests(fit)) > 1e-3


def test_without_sizes_it_is_the_ideal_fit(cell):
    machine = _machine(cell, 6, SIZES.scaled(0.0))
    problem = _problem(cell, machine)
    none = replace(SIZES.scaled(0.0), correlated_nm=0.0)
    fit = fit_mechanics(problem, none)
    ideal = minimise(problem, np.zeros(problem.n_unknowns))
    assert fit.design.matrix.shape[1] == 0
    np.testing.assert_allclose(fit.solution.unknowns, ideal.unknowns, atol=0.02)
