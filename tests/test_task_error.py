"""Task errors: the definition, derivatives, the figures of 69 sweeps, and angles."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from path_length import path_length
from scipy.spatial.transform import Rotation
from task_fixtures import paper_estimate, paper_values

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.tasks.error import linear_task_sd, peak_to_peak, task_errors, task_jacobian
from fpcal_bayes.infer.tasks.pose import pose_errors, without_common_turn
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import TASKS, follow_offsets, task_path


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_definition(femto: Cell, opd: str) -> None:
    cell = femto.with_opd(opd)
    model, values = CavityModel.of(cell), paper_values(cell)
    random = np.random.default_rng(0)
    truths = values + 0.1 * cell.free.prior_sd * random.standard_normal((3, len(values)))
    task = task_path(cell, model.vector(values), "tilt-x", n_points=5)
    found = task_errors(model, truths, values, task)

    def change(vector: np.ndarray, q: np.ndarray) -> float:
        return float(path_length(cell, vector, q) - path_length(cell, vector, task.start))

    expected = [[change(model.vector(truth), q) - change(model.vector(values), q) for q in task.q] for truth in truths]
    assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert_allclose(peak_to_peak(found), np.ptp(expected, axis=1), rtol=0, atol=1e-9)
    assert_allclose(task_errors(model, values, values, task), 0.0, rtol=0, atol=1e-12)
    paired = task_errors(model, truths, truths + 0.0, task)
    assert_allclose(paired, 0.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", TASKS)
def test_jacobian_is_the_derivative_of_the_error(femto: Cell, name: str) -> None:
    model, values = CavityModel.of(femto), paper_values(femto)
    task = task_path(femto, model.vector(values), name, n_points=5)
    step = 1e-4 * np.diag(femto.free.prior_sd)
    ahead, behind = task_errors(model, values + step, values, task), task_errors(model, values - step, values, task)
    differences = (ahead - behind).T / (2e-4 * femto.free.prior_sd)
    jacobian = task_jacobian(model, values, task)
    assert_allclose(jacobian * femto.free.prior_sd, differences * femto.free.prior_sd, rtol=0, atol=1e-6)


def test_figures_of_the_papers_sweeps(femto: Cell) -> None:
    """Worst-point standard deviations in nm with Tables II and III as truth and 5 nm noise, by another program.

    That program takes the midpoint of a sweep as a row of its own; sharing the reading at the start changes them.
    """
    model = CavityModel.of(femto)
    expected = {
        (False, False): {"circle": 0.99, "tilt-x": 31.5, "tilt-z": 8.5, "spin": 3.3},
        (True, True): {"circle": 0.79, "tilt-x": 2.0, "tilt-z": 1.8, "spin": 1.3},
        (True, False): {"circle": 0.84, "tilt-x": 1.43, "tilt-z": 1.35, "spin": 1.28},
    }
    spin = np.zeros((81, 6))
    spin[:, 4] = np.radians(np.linspace(-40.0, 40.0, 81))
    for (midpoints, independent), figures in expected.items():
        estimate = paper_estimate(femto, midpoints=midpoints, independent=independent)
        for name, figure in figures.items():
            if name == "spin":
                task = follow_offsets(femto, estimate.vector(), name, spin)
            else:
                task = task_path(femto, estimate.vector(), name)
            sd = linear_task_sd(task_jacobian(model, estimate.values, task), estimate.covariance)
            assert 1e3 * sd.max() == pytest.approx(figure, rel=0.03)


def test_linear_sd_is_that_of_draws(femto: Cell) -> None:
    random = np.random.default_rng(1)
    jacobian, root = random.standard_normal((4, 3)), random.standard_normal((3, 3))
    draws = random.standard_normal((200_000, 3)) @ root.T @ jacobian.T
    assert_allclose(linear_task_sd(jacobian, root @ root.T), draws.std(axis=0), rtol=0.01)
    assert linear_task_sd(jacobian, np.zeros((3, 3))).tolist() == [0.0] * 4


def test_angles_of_a_fibre_that_is_turned(femto: Cell) -> None:
    """A light direction that is 0.3 deg off is 0.3 deg off the mirror normal, and no turn since the start."""
    model, values = CavityModel.of(femto), paper_values(femto)
    task = task_path(femto, model.vector(values), "spin", n_points=7)
    truth = values.copy()
    truth[femto.free.position("beta_wf")] += np.radians(0.3)
    for linear in (False, True):
        angles = pose_errors(model, truth, values, task, linear=linear)
        assert angles.normal.shape == (1, 7)
        assert_allclose(np.degrees(angles.normal), 0.3, rtol=1e-4)
    same = pose_errors(model, values, values, task)
    assert_allclose(same.normal, 0.0, rtol=0, atol=1e-9)
    assert_allclose(same.turn, 0.0, rtol=0, atol=1e-9)


def test_angles_agree_with_4x4_products(femto: Cell) -> None:
    model, values = CavityModel.of(femto), paper_values(femto)
    random = np.random.default_rng(2)
    truth = values + 0.5 * femto.free.prior_sd * random.standard_normal(len(values))
    task = task_path(femto, model.vector(values), "tilt-z", n_points=3)
    angles = pose_errors(model, truth, values, task)

    def mirror(which: np.ndarray, q: np.ndarray) -> np.ndarray:
        vector = model.vector(which)
        return (np.linalg.inv(chain.fibre_in_world(vector)) @ chain.mirror_pose(femto, vector, q))[:3, :3]

    for i, q in enumerate(task.q):
        true, expected = mirror(truth, q), mirror(values, q)
        assert np.cos(angles.normal[0, i]) == pytest.approx(true[:, 2] @ expected[:, 2], abs=1e-12)
        turns = [mirror(which, q) @ mirror(which, task.start).T for which in (truth, values)]
        trace = np.trace(turns[0] @ turns[1].T)
        assert np.cos(angles.turn[0, i]) == pytest.approx((trace - 1) / 2, abs=1e-12)


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
@pytest.mark.parametrize("name", ["circle", "tilt-x", "spin"])
def test_moves_agree_with_4x4_products(femto: Cell, name: str, opd: str) -> None:
    """Moves of the mirror point since the start, with their common turn taken out by Kabsch's rotation."""
    cell = femto.with_opd(opd)
    model, values = CavityModel.of(cell), paper_values(cell)
    truth = values + 0.3 * cell.free.prior_sd * np.random.default_rng(3).standard_normal(len(values))
    task = task_path(cell, model.vector(values), name, n_points=6)
    found = pose_errors(model, truth, values, task).changes[0]
    moves, turned = [], []
    for vector in (model.vector(values), model.vector(truth)):
        _, point = chain.reflection_point(cell, vector, np.zeros(6))
        joints = np.vstack([task.start, task.q])
        poses = [np.linalg.inv(chain.fibre_in_world(vector)) @ chain.mirror_pose(cell, vector, q) for q in joints]
        places = np.array([(pose @ [*point, 1.0])[[0, 2]] for pose in poses])
        moves.append(places[1:] - places[0])
        turned.append(Rotation.from_matrix([pose[:3, :3] @ poses[0][:3, :3].T for pose in poses[1:]]))
    if name == "circle":
        left, _, right = np.linalg.svd(moves[1].T @ moves[0])
        moves[1] = moves[1] @ left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    assert np.abs(moves[1] - moves[0]).max() > 0.1
    assert_allclose(found[:, :2], moves[1] - moves[0], rtol=0, atol=1e-9)
    assert_allclose(found[:, 2:], (turned[1] * turned[0].inv()).as_rotvec(), rtol=0, atol=1e-12)


def test_a_common_turn_about_the_beam_is_no_error(femto: Cell) -> None:
    """To first order what is taken out of small changes is what is taken out of all, and a turn leaves nothing."""
    model, values = CavityModel.of(femto), paper_values(femto)
    task = task_path(femto, model.vector(values), "circle", n_points=9)
    moves = task.offsets[:, [0, 2]] - task.offsets[0, [0, 2]]
    turned = np.zeros((1, 9, 5))
    angle = 1e-6
    start = task.offsets[:, [0, 2]]
    turned[0, :, 0], turned[0, :, 1] = angle * start[:, 1], -angle * start[:, 0]
    assert np.abs(moves).max() > 100.0
    assert_allclose(without_common_turn(model, values, task, turned), 0.0, rtol=0, atol=1e-9)
    stretched = np.zeros((1, 9, 5))
    stretched[0, :, 0] = 1e-6 * start[:, 0]
    left = without_common_turn(model, values, task, stretched)
    assert np.abs(left[..., 0]).max() == pytest.approx(1e-4, rel=0.01)


def test_linear_angles_are_the_limit_of_small_errors(femto: Cell) -> None:
    model, values = CavityModel.of(femto), paper_values(femto)
    task = task_path(femto, model.vector(values), "tilt-x", n_points=3)
    truth = values + 1e-5 * femto.free.prior_sd
    exact, linear = (pose_errors(model, truth, values, task, linear=flag) for flag in (False, True))
    assert_allclose(linear.normal, exact.normal, rtol=1e-3)
    assert_allclose(linear.turn, exact.turn, rtol=1e-3, atol=1e-9)
    assert_allclose(linear.changes, exact.changes, rtol=1e-3, atol=1e-7)


def test_a_point_out_of_reach_is_named(femto: Cell) -> None:
    model, values = CavityModel.of(femto), paper_values(femto)
    task = task_path(femto, model.vector(values), "circle", n_points=5)
    task.q[3] = np.nan
    task = replace(task, status=np.array(["ok", "ok", "ok", "out of reach", "ok"]))
    with pytest.raises(InputError, match="task 'circle': point 4 of 5: out of reach"):
        task_errors(model, values, values, task)
