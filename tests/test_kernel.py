"""The kernel of cavity lengths: against 4x4 products, and the properties that its layout must not break."""

import numpy as np
import pytest
from conftest import RandomCell, ReferenceCase, random_cells
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.lengths import LANES
from fpcal_bayes.model.parameters import EXTRINSICS

BATCHES = (1, 2, LANES - 1, LANES, LANES + 1, 2 * LANES + 2)


def nearby(random: RandomCell, n: int) -> np.ndarray:
    """Parameter vectors (n, n_free) around those of the cell."""
    steps = np.random.default_rng(0).normal(size=(n, len(random.values)))
    return random.values + 1e-4 * steps * np.abs(random.values)


@given(random_cells())
def test_lengths_are_those_of_the_products(random: RandomCell) -> None:
    rows = random.model.pose_rows(random.poses)
    assert_allclose(random.model.predict(random.values, rows), random.lengths, rtol=0, atol=random.tolerance)


@settings(max_examples=30)
@given(random_cells(), st.sampled_from([1, 3]))
def test_many_poses_are_laid_side_by_side(random: RandomCell, n_vectors: int) -> None:
    """More poses than vectors that differ in their turns take another kernel: the same as each pose by itself."""
    wobble = np.random.default_rng(1).uniform(0.999, 1.001, (2 * LANES + 3, random.poses.shape[1]))
    poses = random.poses[np.arange(len(wobble)) % len(random.poses)] * wobble
    values = nearby(random, n_vectors)
    found = random.model.predict(values, random.model.pose_rows(poses))
    alone = [random.model.predict(values, random.model.pose_rows(pose[None]))[:, 0] for pose in poses]
    assert_allclose(found, np.transpose(alone), rtol=0, atol=random.tolerance)


@given(random_cells())
def test_changes_are_differences_of_lengths(random: RandomCell) -> None:
    start, end = random.poses[:3], random.poses[3:]
    absolute = np.array([False, True, False])
    lengths = random.lengths
    expected = lengths[3:] - np.where(absolute, 0.0, lengths[:3])
    rows = random.model.rows(start, end, absolute)
    assert_allclose(random.model.predict(random.values, rows), expected, rtol=0, atol=2 * random.tolerance)


@pytest.mark.parametrize(("opd", "key"), [("axis", ""), ("perpendicular", "_perpendicular")])
def test_reference_changes(femto: Cell, case_a: ReferenceCase, opd: str, key: str) -> None:
    """The listed changes are rounded to 1e-9 um."""
    model = CavityModel.of(femto.with_opd(opd))
    changes = model.predict(case_a.truth(femto), model.rows(case_a.q_start, case_a.q_end))
    listed = np.array(case_a.content[f"dl_noise_free{key}_um"])
    assert len(listed) == 69
    assert np.abs(changes - listed).max() < 1e-9


@settings(max_examples=30)
@given(random_cells(n_poses=4), st.sampled_from(BATCHES))
def test_batch_size_changes_nothing(random: RandomCell, n: int) -> None:
    rows = random.model.pose_rows(random.poses)
    values = nearby(random, n)
    alone = np.array([random.model.predict(v, rows) for v in values])
    # Instructions over several vectors may fuse a product and a sum that a single one does not.
    assert_allclose(random.model.predict(values, rows), alone, rtol=0, atol=random.tolerance)


@settings(max_examples=30)
@given(random_cells(n_poses=4), st.sampled_from(BATCHES[1:]), st.randoms(use_true_random=False))
def test_order_of_vectors_changes_nothing(random: RandomCell, n: int, shuffler: object) -> None:
    order = list(range(n))
    shuffler.shuffle(order)
    rows = random.model.pose_rows(random.poses)
    values = nearby(random, n)
    there, back = random.model.predict(values, rows), random.model.predict(values[order], rows)
    assert_allclose(back, there[order], rtol=0, atol=random.tolerance)


@given(random_cells(n_poses=8), st.permutations(range(8)))
def test_order_of_poses_changes_nothing(random: RandomCell, order: list[int]) -> None:
    model = random.model
    straight = model.predict(random.values, model.pose_rows(random.poses))
    permuted = model.predict(random.values, model.pose_rows(random.poses[order]))
    assert_array_equal(permuted, straight[order])


@given(random_cells(n_poses=4), st.lists(st.integers(0, 3), min_size=1, max_size=12))
def test_duplicates_change_nothing(random: RandomCell, picks: list[int]) -> None:
    model = random.model
    single = model.predict(random.values, model.pose_rows(random.poses))
    rows = model.pose_rows(random.poses[picks])
    assert len(rows.poses.prismatic_q) == len({tuple(random.poses[i]) for i in picks})
    assert_array_equal(model.predict(random.values, rows), single[picks])


@given(random_cells(n_poses=1), st.floats(-50.0, 50.0), st.floats(0.0, 1.0))
def test_signed_length_is_linear_in_prismatic_joints(random: RandomCell, travel: float, share: float) -> None:
    cell, q = random.cell, random.poses[0]
    step = np.where(cell.revolute, 0.0, travel)
    poses = np.array([q, q + step, q + share * step])
    first, last, between = random.model.predict(random.values, random.model.pose_rows(poses))
    if cell.opd == "axis":
        assert between == pytest.approx((1 - share) * first + share * last, abs=10 * random.tolerance)
    else:
        # The distance is the absolute value of something linear: convex.
        assert between <= (1 - share) * first + share * last + 10 * random.tolerance


@given(random_cells(), st.floats(-500.0, 500.0))
def test_sliding_the_fibre_along_its_axis(random: RandomCell, slide: float) -> None:
    """On the axis path every length changes by the slide, and no dL does; on the other path lengths do change."""
    model = CavityModel.of(random.cell.with_opd("axis"))
    slots = model.free.positions(["x_wf", "y_wf", "z_wf"])
    moved = random.values.copy()
    first = len(random.vector) - len(EXTRINSICS)
    beta, theta = random.vector[first + 2], random.vector[first + 3]
    if random.cell.optical_axis == "z":
        axis = np.array([0.0, -np.sin(beta), np.cos(beta)])
    else:
        axis = np.array([np.sin(theta), -np.cos(theta) * np.cos(beta), -np.cos(theta) * np.sin(beta)])
    moved[slots] += slide * axis
    rows = model.rows(random.poses[:3], random.poses[3:])
    poses = model.pose_rows(random.poses)
    atol = 2 * random.tolerance + 1e-11 * np.abs(model.predict(random.values, poses)).max()
    assert_allclose(model.predict(moved, rows), model.predict(random.values, rows), rtol=0, atol=atol)
    slid = model.predict(random.values, poses) - slide
    assert_allclose(model.predict(moved, poses), slid, rtol=0, atol=atol)


def test_perpendicular_length_is_not_blind_to_the_slide(femto: Cell, case_a: ReferenceCase) -> None:
    model = CavityModel.of(femto.with_opd("perpendicular"))
    rows = model.rows(case_a.q_start, case_a.q_end)
    truth = case_a.truth(femto)
    moved = truth.copy()
    moved[femto.free.position("y_wf")] += 100.0
    assert np.abs(model.predict(moved, rows) - model.predict(truth, rows)).max() > 0.05


def test_no_vectors_no_rows_no_free_parameters(femto: Cell, case_a: ReferenceCase) -> None:
    model = CavityModel.of(femto)
    rows = model.rows(case_a.q_start, case_a.q_end)
    assert model.predict(np.zeros((0, 21)), rows).shape == (0, 69)
    empty = model.rows(np.zeros((0, 6)), np.zeros((0, 6)))
    assert model.predict(np.zeros((3, 21)), empty).shape == (3, 0)
    held = CavityModel.of(femto, femto.free[:0])
    nominal = model.predict(femto.free.nominal, rows)
    assert_array_equal(held.predict(np.zeros(0), rows), nominal)
    assert_array_equal(held.predict(np.zeros((2, 0)), rows), [nominal, nominal])


def test_held_values_count(femto: Cell, case_a: ReferenceCase) -> None:
    """Freeing a parameter or holding it at the same value gives the same lengths."""
    truth = case_a.truth(femto)
    full = CavityModel.of(femto)
    extrinsic = femto.select("extrinsic")
    part = CavityModel.of(femto, extrinsic, full.vector(truth))
    rows = full.rows(case_a.q_start, case_a.q_end)
    chosen = femto.free.positions(extrinsic.names)
    assert_allclose(part.predict(truth[chosen], rows), full.predict(truth, rows), rtol=0, atol=1e-11)


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
@pytest.mark.parametrize("reach", [0.1, 2.0])
def test_many_rows_are_as_few_of_them(opd: str, reach: float) -> None:
    """Rows in blocks, whose mirror stands on one side of the fibre or, far turned, on both."""
    cell, random = load_cell(opd=opd, mechanics="none"), np.random.default_rng(1)
    start, end = random.uniform(-reach, reach, (2, 9000, 6))
    absolute, model = random.random(9000) < 0.1, CavityModel.of(cell)
    vectors = cell.free.nominal + 1e-3 * random.standard_normal((20, len(cell.free)))
    parts = np.array_split(np.arange(9000), 7)
    whole, few = model.rows(start, end, absolute), [model.rows(start[at], end[at], absolute[at]) for at in parts]
    faced = model.facing(vectors[0], whole)
    assert {faced.side} == ({0} if opd == "axis" or reach > 1.0 else {1, -1} & {faced.side})
    assert faced.side == 0 or {model.facing(vectors[0], part).side for part in few} == {faced.side}
    for values in (vectors[0], vectors):
        assert_array_equal(
            faced.predict(values, whole), np.concatenate([faced.predict(values, part) for part in few], axis=-1)
        )
        lengths, jacobian = faced.predict_with_jacobian(values, whole)
        told = [faced.predict_with_jacobian(values, part) for part in few]
        assert_array_equal(lengths, np.concatenate([part for part, _ in told], axis=-1))
        assert_array_equal(jacobian, np.concatenate([part for _, part in told], axis=-2))
