"""Derivatives by parameters and by joints against complex steps through the 4x4 products."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import RandomCell, ReferenceCase, random_cells
from hypothesis import given, settings
from numpy.testing import assert_allclose, assert_array_equal
from path_length import path_length

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.jacobian import derivative_columns
from fpcal_bayes.model.kernels.lengths import STRIDE

STEP = 1e-30


def complex_step(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Derivatives of `function` (n_out,) by `at` (n,), shape (n_out, n), to rounding."""
    columns = []
    for j in range(len(at)):
        moved = at.astype(complex)
        moved[j] += STEP * 1j
        columns.append(np.imag(function(moved)) / STEP)
    return np.array(columns).T


def assert_columns_agree(found: np.ndarray, expected: np.ndarray) -> None:
    """Every column to 1e-8 of its norm, one that vanishes to 1e-12 of the largest."""
    assert found.shape == expected.shape
    norms = np.linalg.norm(expected, axis=0)
    largest = norms.max(initial=0.0)
    allowed = np.where(norms > 1e-12 * largest, 1e-8 * norms, 1e-12 * largest)
    wrong = np.linalg.norm(found - expected, axis=0)
    assert (wrong <= allowed).all(), f"columns {np.flatnonzero(wrong > allowed)}: off by {wrong[wrong > allowed]}"


def stepped_by_parameters(cell: Cell, vector: np.ndarray, slots: np.ndarray, poses: np.ndarray) -> np.ndarray:
    def lengths(values: np.ndarray) -> np.ndarray:
        moved = vector.astype(complex)
        moved[slots] = values
        return np.array([path_length(cell, moved, q) for q in poses])

    return complex_step(lengths, vector[slots])


@settings(max_examples=60)
@given(random_cells(n_poses=4, max_free=28))
def test_parameters_against_complex_steps(random: RandomCell) -> None:
    model = random.model
    stepped = stepped_by_parameters(random.cell, random.vector, model.free.slots, random.poses)
    lengths, jacobian = model.predict_with_jacobian(random.values, model.pose_rows(random.poses))
    assert_allclose(lengths, random.lengths, rtol=0, atol=random.tolerance)
    assert_columns_agree(jacobian, stepped)
    changes, jacobian = model.predict_with_jacobian(random.values, model.rows(random.poses[:2], random.poses[2:]))
    assert_allclose(changes, random.lengths[2:] - random.lengths[:2], rtol=0, atol=2 * random.tolerance)
    # A difference of rows is as exact as the rows are.
    wrong = np.linalg.norm(jacobian - (stepped[2:] - stepped[:2]), axis=0)
    assert (wrong <= 1e-8 * np.linalg.norm(stepped, axis=0) + 1e-12 * np.linalg.norm(stepped)).all()


@settings(max_examples=60)
@given(random_cells(n_poses=4))
def test_joints_against_complex_steps(random: RandomCell) -> None:
    derivative = random.model.joint_jacobian(random.values, random.poses)
    stepped = np.array(
        [
            complex_step(lambda joints: np.array([path_length(random.cell, random.vector, joints)]), q)[0]
            for q in random.poses
        ]
    )
    assert_columns_agree(derivative, stepped)


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_paper_sweeps_with_every_parameter(case_a: ReferenceCase, opd: str) -> None:
    """The cell of the paper, with its optional gains and runouts away from zero."""
    cell = load_cell(opd=opd, mechanics="none")
    every = [p.name for p in cell.parameters if p.prior_sd > 0]
    assert len(every) == 26
    model = CavityModel.of(cell, cell.select(every))
    values = model.free.nominal + 0.7 * model.free.prior_sd
    ends = [
        stepped_by_parameters(cell, model.vector(values), model.free.slots, q) for q in (case_a.q_start, case_a.q_end)
    ]
    changes, jacobian = model.predict_with_jacobian(values, model.rows(case_a.q_start, case_a.q_end))
    # Columns such as y_wf's on the axis path are differences of equal numbers: compared with the lengths' own columns.
    wrong = np.linalg.norm(jacobian - (ends[1] - ends[0]), axis=0)
    assert (wrong <= 1e-11 * np.linalg.norm(np.vstack(ends), axis=0)).all()
    assert_allclose(changes, model.predict(values, model.rows(case_a.q_start, case_a.q_end)), rtol=0, atol=1e-10)


def test_known_zero_columns(case_a: ReferenceCase) -> None:
    """What no dL sees: y_wf at theta_wf = beta_wf = 0 on the axis path; the optical axis on the perpendicular one."""
    cell = load_cell(mechanics="none")
    model = CavityModel.of(cell)
    _, jacobian = model.predict_with_jacobian(cell.free.nominal, model.rows(case_a.q_start, case_a.q_end))
    assert np.abs(jacobian[:, cell.free.position("y_wf")]).max() < 1e-14
    model = CavityModel.of(cell.with_opd("perpendicular"))
    _, jacobian = model.predict_with_jacobian(case_a.truth(cell), model.rows(case_a.q_start, case_a.q_end))
    blind = cell.free.positions(["beta_wf", "theta_wf"])
    assert_array_equal(jacobian[:, blind], 0.0)
    assert np.abs(jacobian[:, cell.free.position("z_et")]).max() < 1e-12
    assert np.abs(jacobian[:, cell.free.position("y_wf")]).max() > 5e-4


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_reference_singular_values(case_a: ReferenceCase, opd: str) -> None:
    """Rank 16 of 21 on the axis path and 14 on the other, behind a gap of six decades."""
    cell = load_cell(opd=opd, mechanics="none")
    model = CavityModel.of(cell)
    _, jacobian = model.predict_with_jacobian(case_a.truth(cell), model.rows(case_a.q_start, case_a.q_end))
    values = np.linalg.svd(jacobian * cell.free.prior_sd, compute_uv=False)
    rank = {"axis": 16, "perpendicular": 14}[opd]
    assert values[rank - 1] > 1e6 * values[rank]


@settings(max_examples=30)
@given(random_cells(n_poses=4))
def test_batch_of_vectors(random: RandomCell) -> None:
    model = random.model
    rows = model.pose_rows(random.poses)
    many = np.array([random.values, 1.001 * random.values, random.values])
    lengths, jacobians = model.predict_with_jacobian(many, rows)
    assert jacobians.shape == (3, 4, len(random.values))
    for vector, length, jacobian in zip(many, lengths, jacobians, strict=True):
        alone = model.predict_with_jacobian(vector, rows)
        assert_array_equal(length, alone[0])
        assert_array_equal(jacobian, alone[1])


def test_no_vectors_no_rows_no_free_parameters(femto: Cell, case_a: ReferenceCase) -> None:
    model = CavityModel.of(femto)
    rows = model.rows(case_a.q_start, case_a.q_end)
    assert [x.shape for x in model.predict_with_jacobian(np.zeros((0, 21)), rows)] == [(0, 69), (0, 69, 21)]
    empty = model.rows(np.zeros((0, 6)), np.zeros((0, 6)))
    assert [x.shape for x in model.predict_with_jacobian(np.zeros(21), empty)] == [(0,), (0, 21)]
    held = CavityModel.of(femto, femto.free[:0])
    assert [x.shape for x in held.predict_with_jacobian(np.zeros(0), rows)] == [(69,), (69, 0)]


def test_derivative_columns_say_how_many_prismatic_joints_stand_before() -> None:
    revolute = np.array([False, True, False])
    slots = np.arange(3) * STRIDE
    assert derivative_columns(revolute, slots)[:, 4].tolist() == [0, 1, 1]
    assert derivative_columns(revolute, np.array([3 * STRIDE]))[:, 4].tolist() == [2]
    assert derivative_columns(revolute, np.zeros(0, dtype=np.int64)).shape == (0, 5)
