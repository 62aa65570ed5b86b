"""The inverse model, held to the readable 4x4 products of the direct one."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell, make_parameters
from fpcal_bayes.model.cell.joints import Joint
from fpcal_bayes.model.inverse import InverseModel
from fpcal_bayes.model.kernels.inverse import OK, OUT_OF_REACH, SATURATED, SINGULAR, batch_inverse
from fpcal_bayes.model.kernels.lengths import GAIN, STRIDE


def some_cell(kinds: str, travel: float = 200.0, turn: float = np.pi) -> Cell:
    """A chain such as PPPRRR with the same limits on every joint of a kind."""
    joints = tuple(
        Joint("prismatic", -travel, travel, 0.0, None) if kind == "P" else Joint("revolute", -turn, turn, 0.0, None)
        for kind in kinds
    )
    return Cell("random", joints, make_parameters({}, len(kinds)), 1.56, "axis", "minus-y")


def some_vector(cell: Cell, random: np.random.Generator) -> np.ndarray:
    """Every parameter drawn: angles anywhere, lengths of some hundred um, gains of a few per cent, runouts."""
    n = len(cell.joints)
    spread = np.tile([np.pi, np.pi, 200.0, np.pi, 200.0, 0.05, 5.0, 5.0], n)
    spread[6::8][~cell.revolute] = spread[7::8][~cell.revolute] = 0.0
    return np.concatenate([spread * random.uniform(-1.0, 1.0, 8 * n), random.uniform(-1.0, 1.0, 8)])


def some_joints(cell: Cell, random: np.random.Generator, n: int) -> np.ndarray:
    return random.uniform(cell.low, cell.high, (n, len(cell.joints)))


def paper_vector(cell: Cell) -> np.ndarray:
    truth = paper_truth(cell)
    vector = cell.parameters.nominal.copy()
    vector[truth.parameters.slots] = truth.values[0]
    return vector


def check_round_trip(cell: Cell, vector: np.ndarray, q: np.ndarray, least: float) -> int:
    """Solve the poses of `q`; every one that is called met is met, and a share of at least `least` is."""
    inverse = InverseModel(cell)
    poses = inverse.tool_poses(vector, q)
    found = inverse.solve(vector, poses)
    again = inverse.tool_poses(vector, found.q)
    met = np.isin(found.status, (OK, SATURATED))
    assert (found.status == OK).mean() >= least
    assert np.abs(again[met, :3, 3] - poses[met, :3, 3]).max() < 1e-7
    assert np.abs(again[met, :3, :3] - poses[met, :3, :3]).max() < 1e-10
    inside = (found.q >= cell.low - 1e-6) & (found.q <= cell.high + 1e-6)
    assert inside[found.status == OK].all()
    assert not inside[found.status == SATURATED].all(axis=1).any()
    assert np.isnan(found.q[found.status == OUT_OF_REACH]).all()
    return int((found.status == OK).sum())


def test_direct_model_agrees_with_4x4_products() -> None:
    random = np.random.default_rng(0)
    for kinds in ("PPPRRR", "RPRPRP", "RRRRRR", "PRRPRR"):
        cell = some_cell(kinds)
        vector, q = some_vector(cell, random), some_joints(cell, random, 5)
        expected = [chain.tool_pose(cell, vector, joints) for joints in q]
        assert_allclose(InverseModel(cell).tool_poses(vector, q), expected, rtol=0, atol=1e-10)


def test_round_trip_over_random_cells_with_closed_form() -> None:
    """100,000 poses over 200 cells, three prismatic and three revolute joints in any order."""
    random = np.random.default_rng(1)
    good = 0
    for _ in range(200):
        cell = some_cell("".join(random.permutation(list("PPPRRR"))))
        good += check_round_trip(cell, some_vector(cell, random), some_joints(cell, random, 500), least=0.99)
    # What is missing stands within a millionth of a singularity.
    assert good > 99_990


@pytest.mark.parametrize("kinds", ["RRRRRR", "PRRRRR", "RRPRRP", "RRRPRR"])
def test_round_trip_of_chains_without_closed_form(kinds: str) -> None:
    random = np.random.default_rng(2)
    cell = some_cell(kinds)
    for _ in range(2):
        check_round_trip(cell, some_vector(cell, random), some_joints(cell, random, 50), least=0.9)


def test_many_vectors_at_once_are_solved_like_one(femto: Cell) -> None:
    random = np.random.default_rng(3)
    base = paper_vector(femto)
    vectors = base + 1e-3 * random.standard_normal((4, len(base)))
    inverse = InverseModel(femto)
    q = np.where(femto.revolute, 0.05, 50.0) * random.uniform(-1, 1, (7, 6))
    poses = inverse.tool_poses(base, q)
    together = inverse.solve(vectors, poses)
    own = inverse.solve(vectors, inverse.tool_poses(vectors, q))
    assert_allclose(own.q, np.broadcast_to(q, (4, 7, 6)), rtol=0, atol=1e-9)
    for i, vector in enumerate(vectors):
        assert_allclose(together.q[i], inverse.solve(vector, poses).q, rtol=0, atol=1e-9)
        assert_allclose(together.q[i, 0], inverse.solve(vector, poses[0]).q, rtol=0, atol=1e-9)


def all_solutions(inverse: InverseModel, vector: Floats, pose: Floats) -> Floats:
    """Every joint vector inside the limits that takes `pose`, each branch of the kernel asked alone."""
    cell, found = inverse.cell, []
    for branch in range(2 if inverse.closed_form else 1 + len(inverse._starts)):
        limits, targets = (cell.revolute, cell.low, cell.high), np.ascontiguousarray(pose)[None, None]
        q, status, _ = batch_inverse(vector[None], limits, targets, inverse.home, False, inverse._starts, branch)
        if status[0, 0] == OK:
            new = turned(cell, vector, q[0, 0])
            found += [one for one in new if not any((np.abs(one - other) < 1e-6).all() for other in found)]
    return np.array(found).reshape(-1, len(cell.joints))


def turned(cell: Cell, vector: Floats, q: Floats) -> list[Floats]:
    """The same pose with whole turns added, inside the limits of joints that have both."""
    choices = []
    for i, joint in enumerate(cell.joints):
        turns = np.zeros(1)
        if joint.kind == "revolute" and np.isfinite(joint.low) and np.isfinite(joint.high):
            period = 2.0 * np.pi / abs(1.0 + vector[STRIDE * i + GAIN])
            first = np.ceil((joint.low - 1e-9 - q[i]) / period)
            turns = period * np.arange(first, np.floor((joint.high + 1e-9 - q[i]) / period) + 1)
        choices.append(turns)
    return [q + np.array(combination) for combination in product(*choices)]


def test_all_solutions_are_found_in_closed_form() -> None:
    """Two turns of the wrist-like triple, and the joint vector that made the pose is one of them."""
    random = np.random.default_rng(4)
    for _ in range(20):
        cell = some_cell("".join(random.permutation(list("PPPRRR"))), travel=1e4)
        vector, q = some_vector(cell, random), some_joints(cell, random, 1)[0]
        inverse = InverseModel(cell)
        pose = inverse.tool_poses(vector, q[None])[0]
        found = all_solutions(inverse, vector, pose)
        assert len(found) >= 1
        assert min(np.abs(other - q).max() for other in found) < 1e-6
        for other in found:
            assert_allclose(chain.tool_pose(cell, vector, other), pose, rtol=0, atol=1e-7)
        again = inverse.solve(vector, pose, near=q)
        assert_allclose(again.q, q, rtol=0, atol=1e-6)


def test_all_solutions_count_whole_turns_inside_limits(femto: Cell) -> None:
    turning = replace(femto.joints[5], low=-3 * np.pi, high=3 * np.pi)
    cell = replace(femto, joints=(*femto.joints[:5], turning))
    pose = chain.tool_pose(cell, cell.parameters.nominal, np.zeros(6))
    found = all_solutions(InverseModel(cell), cell.parameters.nominal, pose)
    assert_allclose(sorted(found[:, 5]), [-2 * np.pi, 0.0, 2 * np.pi], rtol=0, atol=1e-9)


def test_six_revolute_joints_have_several_solutions() -> None:
    random = np.random.default_rng(5)
    cell = some_cell("RRRRRR")
    vector, q = some_vector(cell, random), some_joints(cell, random, 1)
    inverse = InverseModel(cell)
    pose = inverse.tool_poses(vector, q)[0]
    found = all_solutions(inverse, vector, pose)
    assert len(found) >= 2
    assert min(np.abs(other - q[0]).max() for other in found) < 1e-6
    for other in found:
        assert_allclose(chain.tool_pose(cell, vector, other), pose, rtol=0, atol=1e-6)


def test_saturation_names_the_joint_and_clips_nothing(femto: Cell) -> None:
    vector = paper_vector(femto)
    inverse = InverseModel(femto)
    q = np.array([[0.0, 0, 0, 0, 0, 0], [0, 0, 160.0, 0, 0, 0], [0, 0, 0, 0, np.radians(-7.0), 0]])
    found = inverse.solve(vector, inverse.tool_poses(vector, q))
    assert found.status.tolist() == [OK, SATURATED, SATURATED]
    assert found.joint.tolist() == [-1, 2, 4]
    assert_allclose(found.q, q, rtol=0, atol=1e-9)
    assert found.texts().tolist() == [
        "ok",
        "saturated: q3 at its upper limit 150 um (160 um wanted)",
        "saturated: q5 at its lower limit -5 deg (-7 deg wanted)",
    ]


def test_a_limit_itself_can_be_reached(femto: Cell) -> None:
    vector = paper_vector(femto)
    inverse = InverseModel(femto)
    q = np.where(np.isfinite(femto.high), femto.high, 1.0)[None]
    found = inverse.solve(vector, inverse.tool_poses(vector, q))
    assert found.status.tolist() == [OK]


def test_follow_crosses_half_a_turn_without_a_jump(femto: Cell) -> None:
    """The rotary joint has no limits: a path of two turns stays continuous."""
    vector = paper_vector(femto)
    inverse = InverseModel(femto)
    q = np.zeros((73, 6))
    q[:, 5] = np.linspace(0.0, 4.0 * np.pi, 73)
    found = inverse.solve(vector, inverse.tool_poses(vector, q), near=np.zeros(6), follow=True)
    assert_allclose(found.q, q, rtol=0, atol=1e-9)


def test_parallel_axes_are_singular(femto: Cell) -> None:
    """q5 at 90 deg makes the axes of q4 and q6 parallel; the manufacturers' limits keep it away."""
    free = tuple(replace(joint, low=-np.inf, high=np.inf) for joint in femto.joints)
    cell, vector = replace(femto, joints=free), femto.parameters.nominal
    pose = chain.tool_pose(cell, vector, np.array([1.0, 2.0, 3.0, 0.1, np.pi / 2, 0.2]))
    found = InverseModel(cell).solve(vector, pose)
    assert found.status == SINGULAR
    assert "singular" in str(found.texts())


def test_an_orientation_that_skew_axes_cannot_give_is_out_of_reach() -> None:
    """With 45 deg between consecutive axes the last one tilts by at most 90 deg from the first."""
    cell = some_cell("PPPRRR")
    vector = np.zeros(56)
    vector[8 + 1] = vector[16 + 1] = np.pi / 2  # prismatic joints along three directions
    vector[8 + 3] = np.pi / 2
    inverse = InverseModel(cell)
    first_axis = inverse.tool_poses(vector, np.zeros((1, 6)))[0]
    vector[32 + 1] = vector[40 + 1] = np.pi / 4
    upright = inverse.tool_poses(vector, np.array([[1.0, 2.0, 3.0, 0.3, 1.0, 0.2]]))[0]
    flipped = first_axis @ chain.rot_x(np.pi)
    found = inverse.solve(vector, np.array([upright, flipped]))
    assert found.status.tolist() == [OK, OUT_OF_REACH]
    assert np.isnan(found.q[1]).all()
    assert found.texts()[1] == "out of reach"
    assert all_solutions(inverse, vector, flipped).shape == (0, 6)


@pytest.mark.parametrize(
    "pose",
    [
        np.diag([1.0, 1.0, 1.1, 1.0]),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, 1.0, 2.0]),
    ],
    ids=["stretched", "left-handed", "not a number", "last row"],
)
def test_what_is_no_pose_is_refused(femto: Cell, pose: np.ndarray) -> None:
    inverse = InverseModel(femto)
    with pytest.raises(InputError, match="pose 2: expected finite numbers, an orthonormal"):
        inverse.solve(femto.parameters.nominal, np.array([np.eye(4), pose]))
    with pytest.raises(InputError, match="expected a 4 x 4 transform"):
        inverse.solve(femto.parameters.nominal, np.eye(3))


def test_cells_with_more_than_six_degrees_of_freedom_are_refused() -> None:
    with pytest.raises(InputError, match="has 7 joints: a pose has six degrees of freedom"):
        InverseModel(some_cell("PPPPRRR"))
    with pytest.raises(InputError, match="has 4 prismatic joints"):
        InverseModel(some_cell("PPPPRR"))
