from pathlib import Path

import independent
import numpy as np
import pytest
from scipy import optimize

from fpcal_bayes.infer.fit import minimise as least_squares
from fpcal_bayes.infer.fit.minimise import DECREMENT_TOLERANCE, gauss_newton, minimise, newton_step, polished
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_csv
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.model.cavity import CavityModel

CELL = load_cell(mechanics="none")
CASE_A = Path(__file__).parent / "data" / "case_a.csv"


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem.of(CavityModel.of(CELL), read_csv(CASE_A, CELL))


def drawn(number: int) -> Problem:
    """The problem of truth `number` drawn from the prior, with 5 nm noise."""
    random = np.random.default_rng(5)
    for _ in range(number + 1):
        truth = CELL.free.nominal + CELL.free.prior_sd * random.standard_normal(21)
        noise = 0.005 * random.standard_normal(69)
    plan = paper_protocol(CELL)
    model = CavityModel.of(CELL)
    dl = model.predict(truth, model.rows(plan.q_start, plan.q_end)) + noise
    return Problem.of(model, plan.with_measurement(dl, 0.005))


def test_same_minimum_as_a_trust_region_minimiser_on_an_independent_model(problem):
    fit = independent.Fit(*independent.read_rows(CASE_A))
    found = optimize.minimize(
        fit.total,
        np.zeros(21),
        jac=lambda x: 2 * fit.jacobian(x).T @ fit.residuals(x),
        hess=lambda x: 2 * fit.jacobian(x).T @ fit.jacobian(x),
        method="trust-exact",
        options={"gtol": 1e-6, "maxiter": 200},
    )
    solution = minimise(problem, np.zeros(21))
    assert solution.converged
    assert solution.sum_of_squares == pytest.approx(found.fun, rel=1e-9)
    # In posterior standard deviations the two points are the same to the fourth digit.
    distance = fit.jacobian(found.x) @ (found.x - solution.unknowns)
    assert np.linalg.norm(distance) < 1e-4


def test_the_minimum_does_not_depend_on_the_start(problem):
    expected = minimise(problem, np.zeros(21))
    random = np.random.default_rng(0)
    reached = [minimise(problem, random.standard_normal(21)) for _ in range(20)]
    same = [s for s in reached if abs(s.sum_of_squares - expected.sum_of_squares) < 1e-8]
    # Some starts end in the mirror image of this minimum, which is higher.
    assert len(same) >= 5
    assert all(s.sum_of_squares > expected.sum_of_squares - 1e-8 for s in reached)
    for s in same:
        assert np.linalg.norm(problem.jacobian(s.unknowns) @ (s.unknowns - expected.unknowns)) < 1e-4


def test_at_the_minimum_the_gradient_is_zero(problem):
    solution = minimise(problem, np.zeros(21))
    jacobian, residuals = problem.jacobian(solution.unknowns), problem.residuals(solution.unknowns)
    assert solution.sum_of_squares == pytest.approx(residuals @ residuals, rel=1e-12)
    # Cosine of the angle between the residuals and each column.
    cosine = jacobian.T @ residuals / np.linalg.norm(jacobian, axis=0) / np.linalg.norm(residuals)
    assert np.abs(cosine).max() < 1e-7


def test_newton_converges_where_gauss_newton_runs_away(monkeypatch):
    problem = drawn(99)
    minimum = minimise(problem, np.zeros(21))
    assert minimum.converged
    jacobian = problem.jacobian(minimum.unknowns)
    spread = np.linalg.cholesky(np.linalg.inv(jacobian.T @ jacobian))
    start = minimum.unknowns + 0.1 * spread @ np.full(21, 21**-0.5)

    def decrements(step) -> list[float]:
        point, found = start, []
        for _ in range(6):
            residuals = problem.residuals(point)
            found.append(gauss_newton(problem, point, residuals)[1])
            point = point + step(point, residuals)
        return found

    slow = decrements(lambda point, residuals: gauss_newton(problem, point, residuals)[0])
    fast = decrements(lambda point, residuals: newton_step(problem, point, residuals))
    assert slow[-1] > slow[-2] > slow[-3]
    assert slow[-1] > 1e-3
    assert fast[3] < 1e-7
    # From the same point the polish notices, and gets there in a few steps.
    monkeypatch.setattr(least_squares, "_POLISH_STEPS", 8)
    reached = polished(problem, start)
    assert reached.converged
    assert reached.sum_of_squares == pytest.approx(minimum.sum_of_squares, abs=1e-8)


def test_newton_step_goes_down_where_the_hessian_is_not_positive(problem):
    random = np.random.default_rng(2)
    indefinite = 0
    for _ in range(20):
        point = 2.0 * random.standard_normal(21)
        shifts = 1e-4 * np.eye(21)
        gradient = problem.gradients(point[None])[0]
        hessian = (problem.gradients(point + shifts) - problem.gradients(point - shifts)) / 2e-4
        indefinite += np.linalg.eigvalsh((hessian + hessian.T) / 2).min() < 0
        step = newton_step(problem, point, problem.residuals(point))
        assert step @ gradient < 0
        assert np.linalg.norm(step) <= 1 + 1e-12
    assert indefinite >= 5


@pytest.mark.parametrize("size", [1e-6, 1e-3, 0.1, 1.0, 10.0])
def test_polish_never_increases_the_sum(problem, size):
    random = np.random.default_rng(3)
    minimum = minimise(problem, np.zeros(21)).unknowns
    for _ in range(5):
        start = minimum + size * random.standard_normal(21)
        before = float(np.sum(problem.residuals(start) ** 2))
        solution = polished(problem, start)
        assert solution.sum_of_squares <= before
        after = float(np.sum(problem.residuals(solution.unknowns) ** 2))
        assert after == pytest.approx(solution.sum_of_squares, rel=1e-11)


def test_polish_keeps_a_minimum(problem):
    solution = minimise(problem, np.zeros(21))
    again = polished(problem, solution.unknowns)
    assert again.converged
    assert 0 <= solution.sum_of_squares - again.sum_of_squares < DECREMENT_TOLERANCE


def test_a_search_that_is_cut_short_is_not_called_converged(problem, monkeypatch):
    monkeypatch.setattr(least_squares, "_MAX_EVALUATIONS", 2)
    monkeypatch.setattr(least_squares, "_POLISH_STEPS", 1)
    solution = minimise(problem, np.zeros(21))
    assert not solution.converged
    assert solution.sum_of_squares > 100


def test_nothing_finite_is_not_called_converged(problem):
    with np.errstate(all="ignore"):
        assert not polished(problem, np.full(21, 1e200)).converged
