"""Profiles: exact where the model is linear, flat, finite, and re-optimised."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.observability.measures import bounds_of
from fpcal_bayes.infer.observability.profile import profile
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel

CELL = load_cell(mechanics="none")
TRUTH = paper_truth(CELL).at(0.0)


def identified(plan: Sweeps, free: str) -> Identification:
    """Identify `free`, the others held at nominal exactly, from data of the truth."""
    model = CavityModel.of(CELL)
    exact = model.predict(TRUTH, model.rows(plan.q_start, plan.q_end, plan.absolute))
    noise = np.random.default_rng(0).standard_normal(len(plan))
    return identify(CELL, plan.with_measurement(exact + 0.005 * noise, 0.005), free=free, hold="exact")


@pytest.fixture(scope="module")
def full() -> Identification:
    return identified(paper_protocol(CELL), "all")


def test_a_linear_case_is_a_parabola():
    # The fibre's position enters L = n.(o - f) / (n.a) linearly: the profile of the data is known exactly.
    absolute = replace(paper_protocol(CELL).take(np.arange(20)), kind=np.full(20, "absolute"))
    found = identified(join([paper_protocol(CELL), absolute]), "x_wf,y_wf,z_wf")
    problem = found.problem
    jacobian = problem.data_jacobian(found.solution.unknowns)
    residuals = problem.data_residuals(np.zeros(3))
    best = np.linalg.lstsq(jacobian, -residuals, rcond=None)[0]
    sd = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    for i, name in enumerate(("x_wf", "y_wf", "z_wf")):
        result = profile(problem, found.solution, name)
        assert result.shape == "finite"
        centre, width = problem.values(best)[i], sd[i] * problem.prior.sd[i]
        # The prior, 200 um wide, stays in the fit of the others and pulls by far less than a percent.
        assert result.low == pytest.approx(centre - 1.959964 * width, abs=0.01 * width)
        assert result.high == pytest.approx(centre + 1.959964 * width, abs=0.01 * width)
        np.testing.assert_allclose(
            result.excess + ((result.values[result.excess.argmin()] - centre) / width) ** 2,
            ((result.values - centre) / width) ** 2,
            rtol=0.01,
            atol=0.01,
        )


def test_levels(full):
    widths = [
        np.ptp([p.low, p.high])
        for p in (profile(full.problem, full.solution, "theta_wf", level=x) for x in (0.68, 0.95))
    ]
    expected = stats.norm.ppf(0.5 + 0.95 / 2) / stats.norm.ppf(0.5 + 0.68 / 2)
    assert widths[1] / widths[0] == pytest.approx(expected, rel=0.05)


def test_the_slide_of_the_fibre_is_flat(full):
    found = profile(full.problem, full.solution, "y_wf")
    assert found.shape == "flat"
    assert (found.low, found.high) == (-np.inf, np.inf)
    assert found.excess.max() < 0.05
    assert np.ptp(found.values) > 5 * 200.0


def test_theta_wf_is_finite_and_as_wide_as_its_bound(full):
    found = profile(full.problem, full.solution, "theta_wf")
    position = CELL.free.position("theta_wf")
    jacobian = full.problem.data_jacobian(full.solution.unknowns)
    sd = bounds_of(jacobian).unbiased[position] * CELL.free.prior_sd[position]
    value = full.estimate.values[full.estimate.parameters.position("theta_wf")]
    assert found.shape == "finite"
    assert found.low == pytest.approx(value - 1.96 * sd, abs=0.15 * sd)
    assert found.high == pytest.approx(value + 1.96 * sd, abs=0.15 * sd)
    assert (np.diff(found.values) > 0).all()
    assert found.excess.min() == 0.0


def test_the_others_are_optimised_anew(full):
    # alpha_2 moves with beta_wf: a slice through the maximum is far steeper than the profile.
    found = profile(full.problem, full.solution, "alpha_2")
    position = CELL.free.position("alpha_2")
    jacobian = full.problem.data_jacobian(full.solution.unknowns)
    alone = CELL.free.prior_sd[position] / np.linalg.norm(jacobian[:, position])
    assert found.shape == "finite"
    assert found.high - found.low > 100 * 2 * 1.96 * alone
    for value, excess in zip(found.values, found.excess, strict=True):
        sliced = full.solution.unknowns.copy()
        sliced[position] = (value - CELL.free.nominal[position]) / CELL.free.prior_sd[position]
        residuals = full.problem.data_residuals(sliced)
        least = full.problem.data_residuals(full.solution.unknowns)
        assert excess <= residuals @ residuals - least @ least + 1.0


def test_flat_where_the_reach_ends_before_the_threshold(full):
    # alpha_6 is known to 0.35 deg: within 0.3 prior sd of the maximum the threshold is not passed on either side.
    assert profile(full.problem, full.solution, "alpha_6", reach=0.3).shape == "flat"


def test_an_unknown_name_is_refused(full):
    with pytest.raises(InputError, match="unknown parameter 'theta_9'"):
        profile(full.problem, full.solution, "theta_9")
