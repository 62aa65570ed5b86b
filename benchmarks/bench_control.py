"""The inverse model: microseconds a pose, beside a damped Newton on Pinocchio, whose results must agree."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell, load_cell
from fpcal_bayes.model.inverse import InverseModel

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
    cell = load_cell()
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
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.Model()
    parent, at = 0, pinocchio.SE3.Identity()
    for i, joint in enumerate(case.cell.joints):
        beta, alpha, d, theta, r = case.vector[8 * i : 8 * i + 5]
        turned = pinocchio.utils.rotate("y", beta) @ pinocchio.utils.rotate("x", alpha)
        at = at * pinocchio.SE3(turned, np.zeros(3)) * pinocchio.SE3(np.eye(3), np.array([d, 0.0, 0.0]))
        fixed = pinocchio.SE3(pinocchio.utils.rotate("z", theta), np.array([0.0, 0.0, r]))
        kind = pinocchio.JointModelPZ() if joint.kind == "prismatic" else pinocchio.JointModelRZ()
        parent = model.addJoint(parent, kind, at * fixed, f"q{i + 1}")
        at = pinocchio.SE3.Identity()
    data = model.createData()
    targets = [pinocchio.SE3(pose[:3, :3], pose[:3, 3]) for pose in case.poses]

    def solve(target: object) -> np.ndarray:
        q = np.zeros(6)
        for _ in range(50):
            pinocchio.computeJointJacobians(model, data, q)
            error = pinocchio.log6(data.oMi[6].actInv(target)).vector
            if np.abs(error[:3]).max() < 1e-9 and np.abs(error[3:]).max() < 1e-12:
                break
            jacobian = pinocchio.getJointJacobian(model, data, 6, pinocchio.ReferenceFrame.LOCAL)
            q = q + np.linalg.solve(jacobian.T @ jacobian + 1e-9 * np.eye(6), jacobian.T @ error)
        return q

    assert_allclose([solve(target) for target in targets[:50]], case.q[:50], rtol=0, atol=1e-7)
    timed("inverse model, Pinocchio and damped Newton", 1, solve, targets[0])
