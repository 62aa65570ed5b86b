"""Identification and observability on one core, beside lmfit on the same residuals."""

from typing import Any

import lmfit
import numpy as np
import pytest

from fpcal_bayes.infer import Problem, identify, minimise, observe
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.simulator import simulate_um


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell(mechanics="none")


@pytest.fixture(scope="module")
def sweeps(cell: Cell) -> Sweeps:
    return simulate_um(cell, paper_truth(cell), paper_protocol(cell), sigma=0.005, seed=0)


@pytest.fixture(scope="module")
def problem(cell: Cell, sweeps: Sweeps) -> Problem:
    return Problem.of(CavityModel.of(cell), sweeps)


def test_levenberg_marquardt_from_nominal(benchmark: Any, problem: Problem) -> None:
    solution = benchmark(minimise, problem, np.zeros(problem.n_unknowns))
    assert solution.converged


def test_lmfit_from_nominal(benchmark: Any, problem: Problem) -> None:
    """The peer, with our compiled residuals and its own finite differences."""
    names = problem.model.free.names
    start = lmfit.Parameters()
    for name in names:
        start.add(name, value=0.0)

    def residuals(parameters: lmfit.Parameters) -> np.ndarray:
        return problem.residuals(np.array([parameters[name].value for name in names]))

    found = benchmark(lmfit.minimize, residuals, start, method="leastsq")
    assert found.chisqr < 1.01 * minimise(problem, np.zeros(len(names))).sum_of_squares


def test_identify(benchmark: Any, cell: Cell, sweeps: Sweeps) -> None:
    """With mirror images, covariance, goodness of fit and statuses."""
    assert benchmark(identify, cell, sweeps).converged


def test_observe_69_sweeps(benchmark: Any, cell: Cell, sweeps: Sweeps) -> None:
    assert benchmark(observe, cell, sweeps).spectrum.rank == 16


def test_observe_27600_rows(benchmark: Any, cell: Cell) -> None:
    """Whole traces of 400 points a sweep, measured."""
    plan, points = paper_protocol(cell), 400
    share = np.arange(1, points + 1)[None, :, None] / points
    ends = (plan.q_start[:, None] + share * (plan.q_end - plan.q_start)[:, None]).reshape(-1, 6)
    names = np.repeat(plan.label, points)
    traces = Sweeps.of_um_rad(np.repeat(plan.q_start, points, axis=0), ends, label=names, group=names)
    measured = simulate_um(cell, paper_truth(cell), traces, sigma=0.005, seed=0)
    assert benchmark.pedantic(observe, (cell, measured), rounds=3).spectrum.rank == 17
