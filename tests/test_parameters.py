"""Parameters and sets of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cell.cell import Cell, make_parameters
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, Parameter, ParameterSet


def test_find_by_position_name_and_slice(femto: Cell) -> None:
    free = femto.free
    assert free[0] is free["alpha_2"]
    assert free[-1].name == "z_wf"
    assert isinstance(free[2:5], ParameterSet)
    assert free[2:5].names == free.names[2:5]
    assert [p.name for p in free] == list(free.names)
    assert len(free) == 21
    assert "z_et" in free
    assert "beta_2" not in free
    assert free["z_et"] in free
    assert free.positions(["z_et", "alpha_2"]).tolist() == [free.position("z_et"), 0]


def test_unknown_name(femto: Cell) -> None:
    with pytest.raises(InputError, match=r"unknown parameter 'alpha_9': expected one of alpha_2, "):
        femto.free["alpha_9"]
    with pytest.raises(InputError, match="alpha_9"):
        femto.free.from_mapping({"alpha_9": 1.0})


def test_names_do_not_repeat() -> None:
    parameter = Parameter("a_1", "um", 0.0, 1.0, "intrinsic", 0)
    with pytest.raises(ValueError, match="repeat"):
        ParameterSet([parameter, parameter])


@pytest.mark.parametrize(("unit", "scale"), [("deg", np.pi / 180), ("um", 1.0), ("ppm", 1e-6)])
def test_scales(unit: str, scale: float) -> None:
    parameter = Parameter("a_1", unit, 2.0, 1.0, "intrinsic", 0)
    assert parameter.scale == pytest.approx(scale, rel=1e-15)
    assert parameter.shown(parameter.scale) == 1.0


@given(st.lists(st.floats(-1e6, 1e6), min_size=21, max_size=21))
def test_shown_and_internal_round_trip(shown: list[float]) -> None:
    free = load_cell(mechanics="none").free
    assert_allclose(free.to_shown(free.to_internal(shown)), shown, rtol=1e-14, atol=1e-300)
    assert free.to_internal([shown, shown]).shape == (2, 21)


def test_from_mapping_leaves_the_rest_nominal(femto: Cell) -> None:
    values = femto.free.from_mapping({"alpha_2": -91.0, "z_et": 3.0})
    expected = femto.free.nominal.copy()
    expected[femto.free.position("alpha_2")] = np.radians(-91.0)
    expected[femto.free.position("z_et")] = 3.0
    assert_allclose(values, expected, rtol=1e-15)


def test_slots_follow_the_model_vector(femto: Cell) -> None:
    """Eight numbers a link in LINK_SLOTS order, then EXTRINSICS."""
    names = [f"{stem}_{link}" for link in range(1, 7) for stem in LINK_SLOTS] + list(EXTRINSICS)
    assert list(femto.parameters.names) == names
    assert femto.parameters.slots.tolist() == list(range(6 * 8 + 8))
    assert [names[slot] for slot in femto.free.slots] == list(femto.free.names)


def test_make_parameters_refuses_a_link_that_is_not_there() -> None:
    with pytest.raises(InputError, match="unknown parameter 'alpha_3' for a chain of 2 joints"):
        make_parameters({"alpha_3": (0.0, 1.0, False)}, 2)


def test_labels_for_plots(femto: Cell) -> None:
    assert femto.free["alpha_2"].latex == r"$\alpha_{2}\ [^\circ]$"
    assert femto.free["z_et"].latex == r"$z_{et}\ [\mu m]$"
    assert femto.parameters["gain_4"].latex == r"$g_{4}\ [\mathrm{ppm}]$"
    assert femto.parameters["runout_cos_6"].latex == r"$c_{6}\ [\mu m]$"
    assert len({p.latex for p in femto.parameters}) == len(femto.parameters)
