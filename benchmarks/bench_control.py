"""The inverse model: microseconds a pose, beside a damped Newton on Pinocchio, whose results must agree."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose
from pinocchio_cell import PinocchioCell

from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import paper_truth
from fpcal_bayes.model import CavityModel, Cell, InverseModel

Timer = Callable[..., Any]
N_POSES = 1000


@dataclass(frozen=True)
class Case:
    cell: Cell
    vector: np.ndarray
    inverse: InverseModel
    q: np.ndarray
    poses: np.ndarray


@pytest.fixture(scope="module")
def case() -> Case:
    cell = load_cell(mechanics="none")
    vector = CavityModel.of(cell).vector(paper_truth(cell).values[0])
    inverse = InverseModel(cell)
    width = np.where(cell.revolute, np.radians(5.0), 150.0)
    q = np.random.default_rng(0).uniform(-width, width, (N_POSES, 6))
    return Case(cell, vector, inverse, q, inverse.tool_poses(vector, q))


def test_inverse_batch(case: Case, timed: Timer) -> None:
    found = case.inverse.solve(case.vector, case.poses)
    assert found.ok.all()
    assert_allclose(case.inverse.tool_poses(case.vector, found.q), case.poses, rtol=0, atol=1e-9)
    timed("inverse model, batch", N_POSES, case.inverse.solve, case.vector, case.poses)


def test_inverse_single_call(case: Case, timed: Timer) -> None:
    pose = case.poses[0]
    assert_allclose(case.inverse.solve(case.vector, pose).q, case.q[0], rtol=0, atol=1e-9)
    timed("inverse model, single call", 1, case.inverse.solve, case.vector, pose)


def test_inverse_pinocchio(case: Case, timed: Timer) -> None:
    rival = PinocchioCell(case.cell, case.vector)
    targets = [pinocchio.SE3(pose[:3, :3], pose[:3, 3]) for pose in case.poses]
    assert_allclose([rival.joints_at(target) for target in targets[:50]], case.q[:50], rtol=0, atol=1e-7)
    timed("inverse model, Pinocchio and damped Newton", 1, rival.joints_at, targets[0])
