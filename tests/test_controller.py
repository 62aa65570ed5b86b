"""The controller: absolute and relative moves, paths at bounded steps, a new estimate while it runs."""

import warnings
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from numpy.testing import assert_allclose
from task_fixtures import paper_estimate

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.controller import Controller, interpolate
from fpcal_bayes.motion.validity import StaleEstimateWarning, hours_of_estimate, read_now, stale_text


@pytest.fixture
def estimate(femto: Cell) -> Estimate:
    return paper_estimate(femto)


def pose_by_products(estimate: Estimate, q: np.ndarray) -> np.ndarray:
    """Mirror frame placed at tPr, in the fibre frame, by 4x4 products: X of the paper's Fig 7."""
    vector = estimate.vector()
    _, point = chain.reflection_point(estimate.cell, vector, np.zeros(6))
    mirror = chain.mirror_pose(estimate.cell, vector, q) @ chain.translation(*point)
    return np.linalg.inv(chain.fibre_in_world(vector)) @ mirror


def test_absolute_move_takes_the_pose(estimate: Estimate) -> None:
    controller = Controller(estimate)
    assert_allclose(controller.pose, pose_by_products(estimate, np.zeros(6)), rtol=0, atol=1e-9)
    q = controller.move_to(controller.aligned)
    assert_allclose(pose_by_products(estimate, q), controller.aligned, rtol=0, atol=1e-7)
    assert_allclose(controller.q, q)


def test_relative_moves_in_the_fibre_frame(estimate: Estimate) -> None:
    controller = Controller(estimate)
    controller.move_to(controller.aligned)
    before = controller.pose
    controller.move(translation_um=(12.0, 0.0, -7.0))
    assert_allclose(controller.pose[:3, 3] - before[:3, 3], [12.0, 0.0, -7.0], rtol=0, atol=1e-7)
    assert_allclose(controller.pose[:3, :3], before[:3, :3], rtol=0, atol=1e-10)
    before = controller.pose
    controller.move(rotation_deg=(0.0, 10.0, 0.0))
    assert_allclose(controller.pose[:3, 3], before[:3, 3], rtol=0, atol=1e-7)
    assert_allclose(controller.pose[:3, :3], chain.rot_y(np.radians(10.0))[:3, :3] @ before[:3, :3], atol=1e-10)
    controller.move(rotation_deg=(0.0, -10.0, 0.0))
    controller.move(translation_um=(-12.0, 0.0, 7.0))
    assert_allclose(controller.pose, controller.aligned, rtol=0, atol=1e-7)


def test_moves_that_cannot_be_made_leave_the_joints_alone(estimate: Estimate) -> None:
    controller = Controller(estimate)
    before = controller.q
    with pytest.raises(InputError, match="the pose cannot be taken: saturated: q2 at its upper limit 150 um"):
        controller.move(translation_um=(0.0, 400.0, 0.0))
    with pytest.raises(InputError, match="orthonormal"):
        controller.move_to(1.1 * np.eye(4))
    assert_allclose(controller.q, before, rtol=0, atol=0)


def test_paths_keep_to_the_steps(estimate: Estimate) -> None:
    controller = Controller(estimate)
    controller.move_to(controller.aligned)
    target = controller.aligned
    target[:3, 3] += [40.0, 2.0, 30.0]
    target[:3, :3] = chain.rot_x(np.radians(1.0))[:3, :3] @ target[:3, :3]
    path = controller.path(target, step_um=2.0, step_deg=0.05)
    steps = np.abs(np.diff(path.q, axis=0))
    assert path.ok.all()
    assert steps[:, :3].max() <= 2.0
    assert steps[:, 3:].max() <= np.radians(0.05)
    assert steps[:, :3].max() > 1.5 or steps[:, 3:].max() > np.radians(0.04)
    assert_allclose(path.q[0], controller.q, rtol=0, atol=1e-7)
    assert_allclose(pose_by_products(estimate, path.q[-1]), target, rtol=0, atol=1e-7)
    points = np.array([pose_by_products(estimate, q)[:3, 3] for q in path.q])
    along = (points - points[0]) @ (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0]) ** 2
    assert_allclose(points, points[0] + along[:, None] * (points[-1] - points[0]), rtol=0, atol=1e-6)


def test_useless_steps_are_refused(estimate: Estimate) -> None:
    controller = Controller(estimate)
    with pytest.raises(InputError, match="expected numbers above zero"):
        controller.path(controller.aligned, step_um=0.0)
    with pytest.raises(InputError, match="a million points or less"):
        controller.path(controller.aligned, step_um=1e-9)


def test_interpolation_ends_where_it_should() -> None:
    start, end = np.eye(4), chain.translation(1.0, 2.0, 3.0) @ chain.rot_z(0.4) @ chain.rot_x(0.3)
    poses = interpolate(start, end, 5)
    assert_allclose(poses[0], start, atol=1e-15)
    assert_allclose(poses[-1], end, atol=1e-15)
    assert_allclose(poses[2, :3, 3], [0.5, 1.0, 1.5])
    half = poses[2, :3, :3]
    assert_allclose(half @ half, end[:3, :3], atol=1e-12)


def test_update_while_running(femto: Cell, estimate: Estimate) -> None:
    controller = Controller(estimate)
    q = controller.move_to(controller.aligned)
    newer = replace(estimate, values=estimate.values + 0.01 * estimate.parameters.prior_sd, time_h=8.0)
    controller.update(newer)
    assert controller.estimate.time_h == 8.0
    assert_allclose(controller.q, q, rtol=0, atol=0)
    assert_allclose(controller.pose, pose_by_products(newer, q), rtol=0, atol=1e-9)
    assert_allclose(pose_by_products(newer, controller.move_to(controller.aligned)), controller.aligned, atol=1e-7)
    other = femto.with_opd("perpendicular")
    with pytest.raises(InputError, match="of another cell \\('femto-st', opd 'perpendicular'\\), expected 'femto-st'"):
        controller.update(replace(estimate, cell=other))


def test_bad_start_is_refused(estimate: Estimate) -> None:
    with pytest.raises(InputError, match="q4 = 6 is outside its limits"):
        Controller(estimate, np.array([0, 0, 0, np.radians(6.0), 0, 0]))
    with pytest.raises(InputError, match="expected 6 finite numbers"):
        Controller(estimate, np.zeros(5))


def test_offsets_become_a_task(estimate: Estimate) -> None:
    controller = Controller(estimate)
    task = controller.follow("step", np.array([[0.0] * 6, [5.0, 0, 0, 0, 0, 0]]))
    assert_allclose(task.poses[1] - task.poses[0], chain.translation(5.0, 0, 0) - np.eye(4), atol=1e-12)
    assert task.ok.all()


class TestStale:
    def test_warns_once_an_estimate_past_its_horizon(self, estimate: Estimate) -> None:
        dated = replace(estimate, time_h=24.0, valid_until_h=31.5)
        hours = [31.0]
        controller = Controller(dated, now_h=lambda: hours[0])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            controller.move_to(controller.aligned)
        hours[0] = 33.0
        with pytest.warns(StaleEstimateWarning, match=r"of 24.00 h was valid until 31.50 h, which has passed"):
            controller.move_to(controller.aligned)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            controller.move_to(controller.aligned)
        controller.update(replace(dated, valid_until_h=32.0))
        with pytest.warns(StaleEstimateWarning, match="valid until 32.00 h"):
            controller.move_to(controller.aligned)
        controller.update(replace(dated, valid_until_h=40.0))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            controller.move_to(controller.aligned)

    @pytest.mark.parametrize(("ago_h", "stale"), [(2.0, False), (4.0, True)])
    def test_the_clock_is_asked_where_the_estimate_carries_one(self, estimate, ago_h, stale) -> None:
        made = datetime.now(UTC) - timedelta(hours=ago_h)
        dated = replace(estimate, time_h=24.0, valid_until_h=27.0, data={"utc": made.isoformat()})
        assert hours_of_estimate(dated, made) == pytest.approx(24.0)
        assert (stale_text(dated, read_now(None, dated)) is not None) == stale
        assert stale_text(replace(dated, data={}), read_now(None, replace(dated, data={}))) is None

    def test_an_estimate_that_never_held_is_named_without_a_clock(self, estimate: Estimate) -> None:
        assert "did not hold" in (stale_text(replace(estimate, time_h=5.0, valid_until_h=5.0), None) or "")
        assert stale_text(replace(estimate, valid_until_h=None), 1e6) is None

    @pytest.mark.parametrize("text", ["soon", "nan", "2024-05-01T08:30:00Z"])
    def test_a_time_that_cannot_be_understood(self, estimate: Estimate, text: str) -> None:
        with pytest.raises(InputError, match="--now"):
            read_now(text, estimate)
