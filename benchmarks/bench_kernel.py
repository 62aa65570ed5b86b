"""Cavity lengths and their Jacobian for the paper's 69 sweeps, beside NumPy and Pinocchio.

Every rival computes the mirror poses of the same joint vectors; each is held to the 4x4 products before it is timed.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from conftest import Timer
from numpy.testing import assert_allclose
from pinocchio_cell import PinocchioCell

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from path_length import path_length

from fpcal_bayes.io import load_cell
from fpcal_bayes.model import CavityModel, Cell, Rows, chain

SWEEPS = Path(__file__).parent.parent / "tests" / "data" / "case_a.csv"


@dataclass(frozen=True)
class Case:
    """The built-in cell, 1,000 parameter vectors of its prior, and the two sets of 138 poses."""

    cell: Cell
    model: CavityModel
    values: np.ndarray
    sweeps: Rows
    q: np.ndarray
    unrelated: np.ndarray


@pytest.fixture(scope="module")
def case() -> Case:
    cell = load_cell(mechanics="none")
    with SWEEPS.open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    ends = []
    for end in ("start", "end"):
        names = [f"{name}_{end}_{unit}" for name, unit in (c.split("_") for c in cell.joint_columns)]
        ends.append(np.array([[float(row[name]) for name in names] for row in rows]) * cell.joint_scales)
    random = np.random.default_rng(1)
    model = CavityModel.of(cell)
    values = cell.free.nominal + cell.free.prior_sd * random.normal(size=(1000, len(cell.free)))
    width = np.where(cell.revolute, np.radians(5.0), 150.0)
    unrelated = random.uniform(-width, width, (138, 6))
    return Case(cell, model, values, model.rows(*ends), np.concatenate(ends), unrelated)


def products(case: Case, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Cavity lengths by the readable 4x4 products, shape (n_vectors, n_poses)."""
    vectors = [case.model.vector(v) for v in values]
    return np.array([[path_length(case.cell, vector, pose) for pose in q] for vector in vectors])


def test_paper_sweeps(case: Case, timed: Timer) -> None:
    lengths = products(case, case.values[:2], case.q)
    expected = lengths[:, 69:] - lengths[:, :69]
    assert_allclose(case.model.predict(case.values, case.sweeps)[:2], expected, rtol=0, atol=1e-9)
    timed("138 paper poses, kernel", 1000, case.model.predict, case.values, case.sweeps)


def test_paper_sweeps_single_call(case: Case, timed: Timer) -> None:
    timed("138 paper poses, single call", 1, case.model.predict, case.values[0], case.sweeps)


def test_unrelated_poses(case: Case, timed: Timer) -> None:
    rows = case.model.pose_rows(case.unrelated)
    expected = products(case, case.values[:2], case.unrelated)
    assert_allclose(case.model.predict(case.values, rows)[:2], expected, rtol=0, atol=1e-9)
    timed("138 unrelated poses, kernel", 1000, case.model.predict, case.values, rows)


def test_jacobian_single_call(case: Case, timed: Timer) -> None:
    values, steps = case.values[0], 1e-4 * np.diag(case.cell.free.prior_sd)
    _, jacobian = case.model.predict_with_jacobian(values, case.sweeps)
    ahead, behind = (case.model.predict(values + sign * steps, case.sweeps) for sign in (1, -1))
    differences = ((ahead - behind) / (2e-4 * case.cell.free.prior_sd[:, None])).T
    assert_allclose(jacobian, differences, rtol=1e-4, atol=1e-4)
    timed("69 x 21 Jacobian, single call", 1, case.model.predict_with_jacobian, values, case.sweeps)


def test_jacobian_batch(case: Case, timed: Timer) -> None:
    values = case.values[:100]
    timed("69 x 21 Jacobian, batch of 100", 100, case.model.predict_with_jacobian, values, case.sweeps)


def numpy_lengths(case: Case, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Cavity lengths by batches of 4x4 products, all vectors and poses at once; shape (n_vectors, n_poses)."""
    cell = case.cell
    vectors = np.tile(case.model.held, (len(values), 1))
    vectors[:, cell.free.slots] = values
    cosines, sines = np.cos(vectors), np.sin(vectors)
    pose = np.broadcast_to(np.eye(4), (len(values), len(q), 4, 4))
    for link, revolute in enumerate(cell.revolute):
        at = 8 * link
        cb, ca, sb, sa = cosines[:, at], cosines[:, at + 1], sines[:, at], sines[:, at + 1]
        d, theta, r = vectors[:, at + 2, None], vectors[:, at + 3, None], vectors[:, at + 4, None]
        turned = np.broadcast_to(theta + np.where(revolute, q[:, link], 0.0), pose.shape[:2])
        ct, st, r = np.cos(turned), np.sin(turned), r + np.where(revolute, 0.0, q[:, link])
        cb, ca, sb, sa = cb[:, None], ca[:, None], sb[:, None], sa[:, None]
        transform = np.zeros((*pose.shape[:2], 4, 4))
        transform[..., 0, 0], transform[..., 0, 1] = cb * ct + sb * sa * st, sb * sa * ct - cb * st
        transform[..., 0, 2], transform[..., 0, 3] = sb * ca, d * cb + r * sb * ca
        transform[..., 1, 0], transform[..., 1, 1] = ca * st, ca * ct
        transform[..., 1, 2], transform[..., 1, 3] = -sa, -r * sa
        transform[..., 2, 0], transform[..., 2, 1] = sa * cb * st - sb * ct, sb * st + sa * cb * ct
        transform[..., 2, 2], transform[..., 2, 3] = cb * ca, r * cb * ca - d * sb
        transform[..., 3, 3] = 1.0
        pose = pose @ transform
    mirrors = np.array([chain.mirror_in_tool(case.cell, v) for v in vectors])
    fibres = np.array([chain.fibre_in_world(v) for v in vectors])
    pose = pose @ mirrors[:, None]
    normal, to_mirror = pose[..., :3, 2], pose[..., :3, 3] - fibres[:, None, :3, 3]
    lengths: np.ndarray = (normal * to_mirror).sum(-1) / -(normal * fibres[:, None, :3, 1]).sum(-1)
    return lengths


def test_numpy(case: Case, timed: Timer) -> None:
    values = case.values[:20]
    found = numpy_lengths(case, values, case.q)
    assert_allclose(found[:2], products(case, values[:2], case.q), rtol=0, atol=1e-9)
    timed("138 paper poses, NumPy", 20, numpy_lengths, case, values, case.q)


def test_pinocchio(case: Case, timed: Timer) -> None:
    """Only the kinematics are timed: neither the change of parameters nor the cavity length."""
    vector = case.model.vector(case.values[0])
    rival = PinocchioCell(case.cell, vector)
    for q in (*case.q, *case.unrelated):
        assert_allclose(rival.mirror_pose(q), chain.mirror_pose(case.cell, vector, q), rtol=0, atol=1e-9)
    fibre = pinocchio.updateFramePlacement(rival.model, rival.data, rival.fibre).homogeneous
    assert_allclose(fibre, chain.fibre_in_world(vector), rtol=0, atol=1e-9)
    timed("138 paper poses, Pinocchio", 1, rival.run, list(case.q))


def test_pinocchio_jacobian(case: Case, timed: Timer) -> None:
    """By the six joints; ours is by the 21 parameters."""
    rival = PinocchioCell(case.cell, case.model.vector(case.values[0]))
    q, step = case.q[3], 1e-5
    ahead, behind = ([rival.mirror_pose(q + sign * step * unit)[:3, 3] for unit in np.eye(6)] for sign in (1, -1))
    differences = (np.array(ahead) - np.array(behind)).T / (2 * step)
    assert_allclose(rival.mirror_jacobian(q)[:3], differences, rtol=0, atol=1e-6)
    timed("138 paper poses, Pinocchio Jacobian", 1, rival.run_jacobians, list(case.q))
