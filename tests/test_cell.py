"""Cells: choice of parameters, controller map, hashes, limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import CONTROLLER_UNITS, load_cell
from fpcal_bayes.model.cell.cell import Cell, check_joints, describe
from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.model.parameters import EXTRINSICS

INTRINSICS = (
    *("alpha_2", "theta_2", "alpha_3", "theta_3", "beta_4", "alpha_4", "d_4", "theta_4"),
    *("alpha_5", "d_5", "theta_5", "alpha_6", "theta_6"),
)
TEXT = data_file("femto-st.toml").read_text()


def cell_of(text: str, folder: Path) -> Cell:
    path = folder / "cell.toml"
    path.write_text(text)
    return load_cell(path, mechanics="none")


def changed(old: str, new: str, count: int = 1) -> str:
    assert old in TEXT
    return TEXT.replace(old, new, count)


def test_built_in_cell(femto: Cell) -> None:
    assert femto.name == "femto-st"
    assert [j.kind[0] for j in femto.joints] == ["p", "p", "p", "r", "r", "r"]
    assert femto.joint_columns == ("q1_um", "q2_um", "q3_um", "q4_deg", "q5_deg", "q6_deg")
    assert femto.free.names == (*INTRINSICS, *EXTRINSICS)
    assert (femto.wavelength, femto.opd, femto.optical_axis) == (pytest.approx(1.56), "axis", "minus-y")
    assert_allclose(femto.low, [-150, -150, -150, np.radians(-5), np.radians(-5), -np.inf])
    assert_allclose(femto.high, [150, 150, 150, np.radians(5), np.radians(5), np.inf])
    assert_allclose(femto.joint_scales, [1, 1, 1, *[np.pi / 180] * 3])
    assert not femto.repeatability.any()
    shown = dict(zip(femto.free.names, femto.free.to_shown(femto.free.prior_sd), strict=True))
    expected = dict.fromkeys(shown, 1.0) | dict.fromkeys(["d_4", "d_5", "z_et"], 20.0)
    assert shown == pytest.approx(expected | dict.fromkeys(["x_wf", "y_wf", "z_wf"], 200.0))


def test_select(femto: Cell) -> None:
    assert femto.select("all").names == femto.free.names
    assert femto.select("intrinsic").names == INTRINSICS
    assert femto.select("extrinsic").names == EXTRINSICS
    assert femto.select("intrinsic,extrinsic").names == femto.free.names
    assert femto.select("z_et,alpha_2,z_et").names == ("alpha_2", "z_et")
    assert femto.select(["extrinsic", "d_4"]).names == ("d_4", *EXTRINSICS)
    # Optional parameters only by name.
    assert "gain_4" not in femto.select("all").names
    assert femto.select("all,gain_4,runout_sin_6").names == (
        *INTRINSICS[:8],
        "gain_4",
        *INTRINSICS[8:],
        "runout_sin_6",
        *EXTRINSICS,
    )


@pytest.mark.parametrize("names", ["alpha_9", "", "all,,z_et", "All", "all, z_et"])
def test_select_unknown(femto: Cell, names: str) -> None:
    with pytest.raises(InputError, match=r"unknown parameter .*: expected all, intrinsic, extrinsic, or some of"):
        femto.select(names)


@pytest.mark.parametrize("name", ["alpha_1", "r_3", "gain_1", "runout_cos_4"])
def test_select_without_prior(femto: Cell, name: str) -> None:
    with pytest.raises(InputError, match=f"{name}.* has no prior_sd in cell 'femto-st'"):
        femto.select(name)


@pytest.mark.parametrize(("kind", "unit"), [(kind, unit) for kind, units in CONTROLLER_UNITS.items() for unit in units])
@given(q=st.floats(-1e3, 1e3), zero=st.floats(-1e3, 1e3), sign=st.sampled_from([1, -1]))
def test_controller_map_round_trips(kind: str, unit: str, q: float, zero: float, sign: int) -> None:
    axis = ControllerAxis("m", "1", sign, zero, unit, CONTROLLER_UNITS[kind][unit])
    values = np.array([q, 0.0])
    reading = axis.reading_of(values)
    # The zero takes up digits of the reading.
    atol = 1e-15 * abs(zero) * axis.per_unit + 1e-12
    assert_allclose(axis.joint_value(reading), values, rtol=1e-13, atol=10 * atol)
    assert reading[1] == zero


@pytest.mark.parametrize(
    ("kind", "unit", "one"),
    [
        ("prismatic", "pm", 1e-6),
        ("prismatic", "nm", 1e-3),
        ("prismatic", "um", 1.0),
        ("prismatic", "mm", 1e3),
        ("prismatic", "m", 1e6),
        ("revolute", "udeg", np.pi / 180e6),
        ("revolute", "mdeg", np.pi / 180e3),
        ("revolute", "deg", np.pi / 180),
        ("revolute", "urad", 1e-6),
        ("revolute", "mrad", 1e-3),
        ("revolute", "rad", 1.0),
    ],
)
def test_controller_units(kind: str, unit: str, one: float) -> None:
    axis = ControllerAxis("m", "1", -1, 10.0, unit, CONTROLLER_UNITS[kind][unit])
    assert axis.reading_of(np.array([2 * one])) == pytest.approx(8.0, rel=1e-12)


def test_stage_reads_zero_to_three_hundred(femto: Cell) -> None:
    stage = femto.joints[0].controller
    assert stage is not None
    assert_allclose(stage.reading_of(np.array([-150.0, 0.0, 150.0])), [0.0, 150.0, 300.0])


def test_hash_ignores_layout_and_comments(femto: Cell, tmp_path: Path) -> None:
    plain = "\n".join(line.partition("#")[0].rstrip() for line in TEXT.splitlines())
    assert plain != TEXT
    assert cell_of(plain, tmp_path).sha256 == femto.sha256
    assert cell_of(changed("wavelength_nm = 1560.0", "wavelength_nm   =   1_560"), tmp_path).sha256 == femto.sha256
    assert cell_of(changed('opd = "axis"', ""), tmp_path).sha256 == femto.sha256


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("wavelength_nm = 1560.0", "wavelength_nm = 1560.1"),
        ('opd = "axis"', 'opd = "perpendicular"'),
        ('optical_axis = "minus-y"', 'optical_axis = "z"'),
        ('name = "femto-st"', 'name = "other"'),
        ("limits_um = [-150.0, 150.0]", "limits_um = [-150.0, 151.0]"),
        ("limits_deg = [-5.0, 5.0]", ""),
        ("repeatability_um = 0.0", "repeatability_um = 0.001"),
        ("nominal_deg = -90.0", "nominal_deg = -90.0001"),
        ("prior_sd_deg = 1.0", "prior_sd_deg = 1.1"),
        ("prior_sd_ppm = 300.0, optional = true", "prior_sd_ppm = 300.0, optional = false"),
        ("y_wf = { nominal_um = 920.0", "y_wf = { nominal_um = 920.5"),
        ("d = { nominal_um = 0.0, prior_sd_um = 20.0 }", "d = { nominal_um = 0.0, prior_sd_um = 21.0 }"),
    ],
)
def test_hash_changes_with_what_matters(femto: Cell, tmp_path: Path, old: str, new: str) -> None:
    assert cell_of(changed(old, new), tmp_path).sha256 != femto.sha256


def test_hash_leaves_out_what_changes_no_cavity_length(femto: Cell, tmp_path: Path) -> None:
    assert femto.sha256.startswith("9ef957ab3e19")
    finer = cell_of(changed("resolution_um = 0.0005", "resolution_um = 0.0001"), tmp_path)
    assert finer.resolution.tolist() == [1e-4, *femto.resolution[1:]]
    silent = cell_of("\n".join(line for line in TEXT.splitlines() if "resolution_" not in line), tmp_path)
    assert silent.resolution.tolist() == [0.0] * 6
    assert finer.sha256 == silent.sha256 == femto.sha256


def test_with_opd(femto: Cell) -> None:
    other = femto.with_opd("perpendicular")
    assert (other.opd, femto.opd) == ("perpendicular", "axis")
    assert other.sha256 == load_cell(opd="perpendicular", mechanics="none").sha256
    assert other.with_opd("axis").sha256 == femto.sha256
    assert describe(other) == {"name": "femto-st", "sha256": other.sha256, "opd": "perpendicular"}


def test_free_needs_a_prior_and_is_not_optional(femto: Cell) -> None:
    assert all(p.prior_sd > 0 and not p.optional for p in femto.free)
    bare = replace(femto, parameters=type(femto.parameters)(replace(p, prior_sd=0.0) for p in femto.parameters))
    assert len(bare.free) == 0


def test_repr_says_what_it_is(femto: Cell) -> None:
    assert repr(femto) == "Cell('femto-st', chain PPPRRR, 21 free parameters, opd 'axis')"


def test_limits_are_reachable_and_not_beyond(femto: Cell) -> None:
    at_limits = np.array([femto.low, femto.high])
    # An endless joint stands within two turns of zero.
    at_limits[:, 5] = [-12.5, 12.5]
    check_joints(femto, at_limits, "a.csv", None, femto.joint_columns)
    # Degrees written to a file and read back may differ in the last digit.
    check_joints(femto, np.radians(np.degrees(at_limits)), "a.csv", None, femto.joint_columns)
    outside = np.zeros((3, 6))
    outside[1, 3] = np.radians(5.001)
    with pytest.raises(InputError) as caught:
        check_joints(femto, outside, "a.csv", None, femto.joint_columns)
    message = "a.csv: row 2, column q4_deg: 5.001 deg is outside the limits of cell 'femto-st', expected -5 to 5 deg"
    assert str(caught.value) == message
    with pytest.raises(InputError, match="row 17, column q4_deg"):
        check_joints(femto, outside, "a.csv", [5, 17, 18], femto.joint_columns)
