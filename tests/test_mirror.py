import numpy as np
import pytest

from fpcal_bayes.infer.fit.minimise import minimise, sign_images
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
FREE = CELL.free


def problem_of(cell: Cell = CELL, midpoints: bool = False, rows: slice = slice(None)) -> Problem:
    plan = paper_protocol(cell, midpoints=midpoints)
    sweeps = simulate_um(cell, paper_truth(cell), plan, sigma=0.005, seed=2).take(np.arange(len(plan))[rows])
    return Problem.of(CavityModel.of(cell), sweeps)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of()


def test_theta_2_against_alpha_5_is_mirrored(problem):
    solution = minimise(problem, np.zeros(21))
    images = sign_images(problem, solution)
    assert 1 <= len(images) <= 3
    moved = [image - solution.unknowns for image in images]
    pair = FREE.positions(["theta_2", "alpha_5"])
    # One image reverses the combination that the nominal geometry hides.
    best = max(moved, key=lambda m: np.linalg.norm(m[pair]) / np.linalg.norm(m))
    assert np.linalg.norm(best[pair]) > 0.5 * np.linalg.norm(best)


def test_an_image_is_a_reflection(problem):
    solution = minimise(problem, np.zeros(21))
    for image in sign_images(problem, solution):
        # The prior, round in these units, does not tell a point from its mirror image.
        assert np.linalg.norm(image) == pytest.approx(np.linalg.norm(solution.unknowns), rel=1e-9)
        assert np.linalg.norm(image - solution.unknowns) > 1e-3


def test_images_do_not_depend_on_the_sign_of_the_directions(problem):
    solution = minimise(problem, np.zeros(21))
    images = sign_images(problem, solution)
    assert all(np.allclose(a, b) for a, b in zip(images, sign_images(problem, solution), strict=True))


def test_images_lead_to_the_other_minimum():
    # Truth 427 drawn from the prior: the fit from nominal ends in the higher of two minima.
    random = np.random.default_rng(5)
    for _ in range(428):
        truth = FREE.nominal + FREE.prior_sd * random.standard_normal(21)
        noise = 0.005 * random.standard_normal(69)
    plan = paper_protocol(CELL)
    model = CavityModel.of(CELL)
    dl = model.predict(truth, model.rows(plan.q_start, plan.q_end)) + noise
    problem = Problem.of(model, plan.with_measurement(dl, 0.005))
    first = minimise(problem, np.zeros(21))
    others = [minimise(problem, image).sum_of_squares for image in sign_images(problem, first)]
    assert min(others) < first.sum_of_squares - 1e-3


@pytest.mark.parametrize(
    ("cell", "midpoints", "rows"),
    [(CELL, True, slice(None)), (CELL.with_opd("perpendicular"), False, slice(None)), (CELL, False, slice(0, 1)),
     (CELL, False, slice(66, 69))],
)  # fmt: skip
def test_other_data(cell, midpoints, rows):
    problem = problem_of(cell, midpoints, rows)
    solution = minimise(problem, np.zeros(21))
    images = sign_images(problem, solution)
    assert len(images) <= 3
    for image in images:
        assert image.shape == (21,)
        assert np.isfinite(image).all()


def test_considered_unknowns_are_left_where_they_are():
    from fpcal_bayes.infer.fit.problem import Considered

    sweeps = simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL), sigma=0.005, seed=2)
    free, held = CELL.select("intrinsic"), CELL.select("extrinsic")
    considered = Considered.of(held, np.diag(1e-4 * held.prior_sd**2))
    vector = CELL.parameters.nominal.copy()
    problem = Problem.of(CavityModel.of(CELL, free, vector), sweeps, considered)
    solution = minimise(problem, np.zeros(problem.n_unknowns))
    images = sign_images(problem, solution)
    assert images
    for image in images:
        np.testing.assert_array_equal(image[13:], solution.unknowns[13:])
        assert (image[:13] != solution.unknowns[:13]).any()
