"""The slip likelihood: its density, and what sampling it says."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats
from test_slips import slipped_sweeps

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.slips import MOST_HALF_WAVES, find_slips
from fpcal_bayes.infer.posterior.netcdf import slip_probabilities, summarise
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.posterior.target_slip import LOGIT_MEAN, LOGIT_SD, SlipTarget
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sharing import Sharing
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate_um


@pytest.fixture(scope="module")
def slipped(femto: Cell):
    clean, sweeps, counts = slipped_sweeps(femto, seed=3, n_slips=4)
    result = identify(femto, sweeps)
    return clean, sweeps, counts, result, SlipTarget(find_slips(result.problem, result.solution))


def test_density_is_the_mixture_over_all_counts(femto: Cell, slipped) -> None:
    """Row by row, written out with the measured values, which the target itself never sees."""
    _, sweeps, _, result, target = slipped
    rng = np.random.default_rng(0)
    at = find_slips(result.problem, result.solution).solution.unknowns
    points = np.column_stack([at + 1e-4 * rng.standard_normal((5, len(at))), rng.standard_normal(5)])
    found = target.log_density(target.data_residuals(points), points)
    expected = np.empty(5)
    for i, point in enumerate(points):
        eps = special.expit(LOGIT_MEAN + LOGIT_SD * point[-1])
        predicted = result.problem.model.predict(result.problem.values(point[:-1]), result.problem.rows)
        total = stats.norm.logpdf(point).sum()
        for dl, mean in zip(sweeps.dl, predicted, strict=True):
            terms = []
            for count in range(-MOST_HALF_WAVES, MOST_HALF_WAVES + 1):
                weight = eps / (2 * MOST_HALF_WAVES) if count else 1 - eps
                off = dl - count * 0.5 * femto.wavelength
                terms.append(np.log(weight) + stats.norm.logpdf(off, mean, 0.005))
            total += special.logsumexp(terms)
        expected[i] = total
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-9, atol=1e-6)
    per_row = target.log_likelihoods(points).sum(axis=1) + stats.norm.logpdf(points).sum(axis=1)
    np.testing.assert_allclose(per_row, expected, rtol=1e-9)


def test_derivatives_are_those_of_the_residuals(slipped) -> None:
    *_, target = slipped
    point = np.zeros(target.n_unknowns) + 0.01
    residuals, jacobian = target.data_batch(point[None])
    # Two kernels: equal up to the rounding of lengths near 1 mm.
    np.testing.assert_allclose(residuals, target.data_residuals(point[None]), rtol=0, atol=1e-8)
    for j in (0, 7, target.n_unknowns - 1):
        step = np.zeros(target.n_unknowns)
        step[j] = 1e-5
        ahead, behind = target.data_residuals(np.array([point + step, point - step]))
        np.testing.assert_allclose(jacobian[0, :, j], (ahead - behind) / 2e-5, rtol=1e-5, atol=1e-4)


@pytest.mark.slow
def test_slipped_sweeps_are_flagged_and_do_no_harm(femto: Cell, slipped) -> None:
    clean, _, counts, result, _ = slipped
    posterior = sample(result, draws=1500, likelihood="slip", seed=1)
    assert posterior.converged, posterior.failures
    probability = dict(slip_probabilities(posterior))
    labels = clean.label
    assert all(probability[str(labels[i])] > 0.99 for i in np.flatnonzero(counts))
    assert all(probability[str(labels[i])] < 0.5 for i in np.flatnonzero(counts == 0))
    reference = summarise(sample(identify(femto, clean), draws=1500, seed=2))
    found = summarise(posterior)
    for name, entry in reference.items():
        assert abs(found[name]["mean"] - entry["mean"]) < 0.2 * entry["sd"], name
        assert abs(found[name]["sd"] / entry["sd"] - 1) < 0.15, name


@pytest.fixture(scope="module")
def grouped(femto: Cell):
    """Sweeps with midpoints; one slips in its first half, which both of its rows show, one in its second."""
    plan = paper_protocol(femto, midpoints=True)
    clean = simulate_um(femto, paper_truth(femto), plan, sigma=0.005, seed=0)
    counts = np.zeros(len(clean), dtype=int)
    counts[[10, 11, 33]] = (1, 1, -2)
    result = identify(femto, replace(clean, dl=clean.dl + 0.5 * femto.wavelength * counts))
    return clean, counts, result, SlipTarget(find_slips(result.problem, result.solution))


def test_rows_that_share_a_reading_are_summed_over_together(femto: Cell, grouped) -> None:
    """All 49 pairs of slips of each group, with the group's covariance written out; noise of a quarter wave too.

    The count of the second row is off by what slipped before and after the first.
    """
    *_, result, target = grouped
    rng = np.random.default_rng(0)
    counts = np.arange(-MOST_HALF_WAVES, MOST_HALF_WAVES + 1)
    for factor in (1.0, 80.0):
        sweeps = result.problem.sweeps
        problem = type(result.problem).of(
            result.problem.model, sweeps.with_measurement(sweeps.dl, factor * sweeps.sigma), None
        )
        target = SlipTarget(find_slips(problem, result.solution))
        point = np.append(result.solution.unknowns + 1e-5 * rng.standard_normal(21), 0.3)[None]
        eps = special.expit(LOGIT_MEAN + LOGIT_SD * point[0, -1])
        predicted = problem.model.predict(problem.values(point[0, :-1]), problem.rows)
        total, per_row, slipped = stats.norm.logpdf(point).sum(), [], []
        weight = np.where(counts, np.log(eps / (2 * MOST_HALF_WAVES)), np.log1p(-eps))
        cov = (factor * 0.005) ** 2 * np.array([[1.0, 0.5], [0.5, 1.0]])
        for members in Sharing.of(sweeps).read_alike:
            levels = np.stack(np.broadcast_arrays(counts[:, None], counts[:, None] + counts), axis=-1)
            pairs = (sweeps.dl - predicted)[members] - levels * 0.5 * femto.wavelength
            terms = stats.multivariate_normal([0.0, 0.0], cov).logpdf(pairs) + weight[:, None] + weight
            first = special.logsumexp(stats.norm.logpdf(pairs[:, 0, 0], 0.0, factor * 0.005) + weight)
            joint = special.logsumexp(terms)
            per_row += [first, joint - first]
            stayed = np.exp(terms - joint)
            slipped += [1 - stayed[levels[..., i] == 0].sum() for i in range(2)]
            total += joint
        found = target.log_density(target.data_residuals(point), point) + target.log_scale.sum()
        prior_constant = stats.norm.logpdf(point).sum() + 0.5 * (point**2).sum()
        np.testing.assert_allclose(found + prior_constant, total, rtol=1e-8)
        np.testing.assert_allclose(target.log_likelihoods(point)[0], per_row, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(target.slip_probabilities(point)[0], slipped, atol=1e-6)


@pytest.mark.slow
def test_slips_within_a_sweep_are_flagged_in_its_rows(femto: Cell, grouped) -> None:
    _, counts, result, _ = grouped
    posterior = sample(result, draws=300, likelihood="slip", seed=1)
    assert posterior.converged, posterior.failures
    shares = dict(slip_probabilities(posterior))
    probability = np.array([shares[label] for label in result.problem.sweeps.label.tolist()])
    assert (probability[counts != 0] > 0.99).all()
    assert (probability[counts == 0] < 0.5).all()


@pytest.mark.parametrize(("slips", "right"), [((2, 4), True), ((3, 6), True), ((3, 7), False), ((5, 5), False)])
def test_slips_that_add_up_are_followed_or_called_a_poor_fit(femto: Cell, slips, right: bool) -> None:
    """Midpoint and end of one sweep off by so many half waves; up to three slip between two readings."""
    plan = paper_protocol(femto, midpoints=True)
    clean = simulate_um(femto, paper_truth(femto), plan, sigma=0.005, seed=1)
    counts = np.zeros(len(clean), dtype=int)
    counts[[20, 21]] = slips
    result = identify(femto, replace(clean, dl=clean.dl + 0.5 * femto.wavelength * counts))
    found = find_slips(result.problem, result.solution)
    target = SlipTarget(found)
    assert (found.counts.tolist() == counts.tolist()) is right
    # The fit with its corrections stands for the draws: where it fails, it fails by hundreds of standard deviations.
    point = np.append(found.solution.unknowns, target.reference)
    jacobian = found.problem.jacobian(found.solution.unknowns)
    rng = np.random.default_rng(2)
    around = np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian).T, rng.standard_normal((21, 2000))).T
    points = point + np.column_stack([around, np.zeros(2000)])
    p_value = target.predictive_p(points, rng)
    assert (p_value > 0.01) if right else (p_value < 1e-3)


def test_each_likelihood_has_a_fit_of_its_own(femto: Cell, slipped) -> None:
    """Rows whose noise is four times what they state: outliers do not explain that."""
    clean, *_ = slipped
    rng = np.random.default_rng(5)
    result = identify(femto, replace(clean, dl=clean.dl + 0.02 * rng.standard_normal(len(clean))))
    poor = sample(result, draws=20, likelihood="student", max_steps=60)
    assert poor.predictive_p < 1e-3
    assert not poor.trust.usable
    assert "the Student-t posterior predicts" in poor.misfit
    good = sample(identify(femto, clean), draws=20, likelihood="student", max_steps=60)
    assert good.predictive_p > 0.01


def test_rows_of_unknown_sign_are_refused(slipped) -> None:
    *_, result, _ = slipped
    slips = find_slips(result.problem, result.solution)
    sweeps = replace(slips.problem.sweeps, signed=np.arange(len(slips.problem.sweeps)) != 3)
    with pytest.raises(InputError, match=r"row 5, column signed: .* known sign"):
        SlipTarget(replace(slips, problem=replace(slips.problem, sweeps=sweeps)))


def test_more_slips_make_them_likelier(femto: Cell) -> None:
    """The mode of eps follows the number of corrections."""
    modes = []
    for n_slips in (0, 3, 6):
        _, sweeps, _ = slipped_sweeps(femto, seed=5, n_slips=n_slips)
        result = identify(femto, sweeps)
        modes.append(SlipTarget(find_slips(result.problem, result.solution)).reference)
    assert all(a < b for a, b in itertools.pairwise(modes))
