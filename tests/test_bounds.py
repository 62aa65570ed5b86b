"""Cramer-Rao bounds against dense inverses."""

import numpy as np

from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.observability.measures import bounds_of
from fpcal_bayes.infer.observability.observe import whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel

CELL = load_cell(mechanics="none")


def test_bounds_of_a_full_rank_problem_are_those_of_the_inverse():
    jacobian = np.random.default_rng(0).standard_normal((12, 5)) * [1.0, 10.0, 0.1, 3.0, 1.0]
    found, information = bounds_of(jacobian), jacobian.T @ jacobian
    np.testing.assert_allclose(found.unbiased, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-10)
    np.testing.assert_allclose(found.with_prior, np.sqrt(np.diag(np.linalg.inv(information + np.eye(5)))), rtol=1e-10)


def test_infinite_exactly_for_the_parameters_of_the_null_space():
    # The first two parameters show only as a sum, the fifth not at all.
    random = np.random.default_rng(1)
    mixed = random.standard_normal((12, 3)) @ np.array([[1, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0.5, 2, 0]])
    found = bounds_of(mixed)
    assert np.isinf(found.unbiased).tolist() == [True, True, False, False, True]
    pseudo = np.sqrt(np.diag(np.linalg.pinv(mixed.T @ mixed)))
    np.testing.assert_allclose(found.unbiased[2:4], pseudo[2:4], rtol=1e-9)
    assert (found.with_prior <= 1.0 + 1e-12).all()
    np.testing.assert_allclose(found.with_prior[4], 1.0)


def test_fewer_rows_than_parameters():
    found = bounds_of(np.array([[3.0, 0.0, 0.0]]))
    assert found.unbiased.tolist() == [1 / 3, np.inf, np.inf]
    np.testing.assert_allclose(found.with_prior, [1 / np.sqrt(10.0), 1.0, 1.0])


def test_the_papers_sweeps():
    sweeps = paper_protocol(CELL).with_measurement(np.zeros(69), 0.005)
    jacobian = whitened_jacobian(CavityModel.of(CELL), sweeps, paper_truth(CELL).at(0.0))
    found, spectrum = bounds_of(jacobian), spectrum_of(jacobian)
    unbounded = [name for name, bound in zip(CELL.free.names, found.unbiased, strict=True) if np.isinf(bound)]
    expected = [
        "theta_3",
        "beta_4",
        "alpha_4",
        "d_4",
        "theta_4",
        "d_5",
        "theta_6",
        "beta_et",
        "theta_et",
        "z_et",
        "x_wf",
        "y_wf",
        "z_wf",
    ]
    assert unbounded == expected
    assert (spectrum.null_share[np.isfinite(found.unbiased)] < 1e-12).all()
    dense = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian + np.eye(21))))
    np.testing.assert_allclose(found.with_prior, dense, rtol=1e-6)
    assert (found.with_prior <= found.unbiased).all()
