"""The cavity model's own part: layout of rows, reflection points, joint derivatives on the built-in cell."""

import numpy as np
import pytest
from conftest import ReferenceCase
from numpy.testing import assert_allclose, assert_array_equal

from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell


def test_vector_puts_free_values_among_the_held(femto: Cell) -> None:
    free = femto.select("z_et,alpha_2")
    held = np.arange(len(femto.parameters), dtype=float)
    model = CavityModel.of(femto, free, held)
    vector = model.vector(np.array([-1.0, -2.0]))
    expected = held.copy()
    expected[femto.parameters.position("alpha_2")] = -1.0
    expected[femto.parameters.position("z_et")] = -2.0
    assert_array_equal(vector, expected)
    assert_array_equal(held, np.arange(len(femto.parameters)))


def test_defaults_are_the_cells_own(femto: Cell) -> None:
    model = CavityModel.of(femto)
    assert model.free.names == femto.free.names
    assert_array_equal(model.vector(femto.free.nominal), femto.parameters.nominal)


def test_reflection_points_of_the_reference(femto: Cell, case_a: ReferenceCase) -> None:
    vector = CavityModel.of(femto).vector(case_a.truth(femto))
    world, mirror = chain.reflection_point(femto, vector, np.zeros(6))
    geometry = case_a.content["geometry_at_zero"]
    assert_allclose(world, geometry["wPr_um"], rtol=0, atol=1e-10)
    assert_allclose(mirror, geometry["tPr_um"], rtol=0, atol=1e-10)


def test_joint_jacobian_of_the_nominal_cell(femto: Cell) -> None:
    """The light leaves along -Y: only q2, which moves the mirror along Y, changes the nominal length."""
    derivative = CavityModel.of(femto).joint_jacobian(femto.free.nominal, np.zeros((1, 6)))
    assert_allclose(derivative, [[0, -1, 0, 0, 0, 0]], rtol=0, atol=1e-12)


def test_absolute_rows_ignore_their_start(femto: Cell, case_a: ReferenceCase) -> None:
    model, truth = CavityModel.of(femto), case_a.truth(femto)
    absolute = np.arange(69) % 2 == 0
    mixed = model.predict(truth, model.rows(case_a.q_start, case_a.q_end, absolute))
    assert_allclose(mixed[absolute], model.predict(truth, model.pose_rows(case_a.q_end))[absolute], rtol=0, atol=0)
    changes = model.predict(truth, model.rows(case_a.q_start, case_a.q_end))
    assert_array_equal(mixed[~absolute], changes[~absolute])


def test_path_models_agree_where_light_meets_the_mirror_squarely(femto: Cell) -> None:
    q = np.zeros((1, 6))
    lengths = []
    for opd in ("axis", "perpendicular"):
        model = CavityModel.of(femto.with_opd(opd))
        lengths.append(model.predict(femto.free.nominal, model.pose_rows(q))[0])
    assert lengths == pytest.approx([920.0, 920.0], abs=1e-12)


def test_wrong_number_of_joints_is_refused(femto: Cell) -> None:
    with pytest.raises(ValueError, match=r"expected \(n, 6\)"):
        CavityModel.of(femto).pose_rows(np.zeros((2, 5)))


def test_inputs_need_not_be_contiguous(femto: Cell, case_a: ReferenceCase) -> None:
    model, truth = CavityModel.of(femto), case_a.truth(femto)
    wide = np.repeat(np.array([truth, truth]), 2, axis=1)[:, ::2]
    q = np.asfortranarray(case_a.q_start)
    rows = model.rows(q, case_a.q_end[:, ::-1][:, ::-1])
    expected = model.predict(truth, model.rows(case_a.q_start, case_a.q_end))
    assert_allclose(model.predict(wide, rows), [expected, expected], rtol=0, atol=1e-11)


@pytest.mark.parametrize("values", [np.zeros(20), np.zeros(22), np.zeros((2, 20)), np.zeros((2, 2, 21))])
def test_vectors_of_another_length_are_refused(femto, values):
    """The kernels look at no shape: they would read beside the array."""
    model = CavityModel.of(femto)
    rows = model.pose_rows(np.zeros((3, 6)))
    for call in (model.predict, model.predict_with_jacobian):
        with pytest.raises(ValueError, match=r"expected \(21,\) or \(n_vectors, 21\)"):
            call(values, rows)
    with pytest.raises(ValueError, match="parameter vectors have shape"):
        model.mirrors(values, np.zeros((3, 6)))


def test_joint_vectors_of_another_length_are_refused(femto):
    model = CavityModel.of(femto)
    for call in (model.pose_rows, lambda q: model.mirrors(np.zeros(21), q)):
        with pytest.raises(ValueError, match=r"joint vectors have shape \(3, 5\), expected \(n, 6\)"):
            call(np.zeros((3, 5)))
