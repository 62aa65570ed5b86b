"""Priors that are stated too small or too large: the factor by evidence, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.prior_sizes import kinds, with_likely_priors
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.infer.tasks.prediction import predict_from_covariance
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.motion.tasks import task_path


def fitted(cell: Cell, factor: float, seed: int = 2, wrong: float = 1.0) -> tuple[Identification, np.ndarray]:
    """A truth from the priors, identified with priors `factor` times as wide and noise `wrong` times as stated."""
    rng, model, plan = np.random.default_rng([seed, 31]), CavityModel.of(cell), paper_protocol(cell)
    truth = cell.free.nominal + rng.standard_normal(len(cell.free)) * cell.free.prior_sd
    exact = model.predict(truth, model.rows(plan.q_start, plan.q_end, plan.absolute))
    stated = replace(cell, parameters=ParameterSet(replace(p, prior_sd=factor * p.prior_sd) for p in cell.parameters))
    measured = plan.with_measurement(exact + wrong * 0.005 * rng.standard_normal(len(plan)), 0.005)
    return identify(stated, measured), truth


def reasons(found: Identification) -> dict[str, str]:
    return {reason.kind: reason.text for reason in found.estimate.trust.reasons}


@pytest.mark.parametrize(("factor", "least", "most"), [(0.1, 3.0, 40.0), (10.0, 0.03, 0.35)])
def test_the_data_contradict_priors_that_are_wrong(femto, factor, least, most):
    found, truth = fitted(femto, factor)
    said = reasons(found)
    assert said["priors"].startswith("the data contradict the stated priors")
    assert found.estimate.trust.usable
    assert said["priors"] in found.warnings
    share = dict(zip(found.free.names, found.problem.prior.sd / (factor * femto.free.prior_sd), strict=True))
    assert least < share["alpha_6"] < most
    # What an estimate states as prior is what it was made with, and its bands hold the true errors.
    assert found.estimate.parameters["alpha_6"].prior_sd == pytest.approx(
        found.problem.prior.sd[found.free.position("alpha_6")]
    )
    model = CavityModel.of(femto)
    for name in ("circle", "tilt-z"):
        task = task_path(found.estimate.cell, found.estimate.vector(), name, n_points=13)
        _, high = predict_from_covariance(found.estimate, task, draws=2000).peak_to_peak_band()
        assert peak_to_peak(task_errors(model, truth, found.estimate.values, task))[0] < 1.5 * high


def test_factors_are_where_the_evidence_is_largest(femto):
    """The evidence as the density of the linearised rows, by another formula."""
    found, _ = fitted(femto, 0.1)
    problem, at = found.problem, found.solution.unknowns
    stated = 0.1 * femto.free.prior_sd
    jacobian = problem.data_jacobian(at) / problem.prior.sd * stated
    rows = jacobian @ (at * problem.prior.sd / stated) - problem.data_residuals(at)
    blocks = [members for _, members in kinds(femto.free)]
    log = np.array([np.log(problem.prior.sd[members[0]] / stated[members[0]]) for members in blocks])

    def evidence(log: np.ndarray) -> float:
        sizes = np.ones(len(stated))
        for members, value in zip(blocks, log, strict=True):
            sizes[members] = np.exp(value)
        covariance = np.eye(len(rows)) + (jacobian * sizes**2) @ jacobian.T
        return float(stats.multivariate_normal.logpdf(rows, np.zeros(len(rows)), covariance)) - 0.5 * float(
            ((log / np.log(3.0)) ** 2).sum()
        )

    assert evidence(log) > evidence(np.zeros(len(log))) + 6.0
    for i in np.flatnonzero(log):
        for step in (-0.3, 0.3):
            assert evidence(log) > evidence(log + step * np.eye(len(log))[i])


def test_priors_that_are_right_stand_to_the_last_digit(femto):
    for seed in range(4):
        found, _ = fitted(femto, 1.0, seed)
        assert "priors" not in reasons(found)
        problem, factors = with_likely_priors(found.problem, found.solution)
        assert problem is found.problem
        assert factors == {}


def test_noise_that_is_stated_too_small_is_not_blamed_on_the_priors(femto):
    found, _ = fitted(femto, 1.0, wrong=4.0)
    assert "priors" not in reasons(found)
    assert "poor-fit" in reasons(found)
    assert np.array_equal(found.problem.prior.sd, femto.free.prior_sd)
