"""The direct geometric model against matrices and plane formulas written out by hand, and its invariants."""

import numpy as np
import pytest
from conftest import RandomCell, ReferenceCase, random_cells
from hypothesis import given
from numpy.testing import assert_allclose
from path_length import path_length

from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS


def written_link(link: np.ndarray, q: float, prismatic: bool) -> np.ndarray:
    """Paper equation (10) with the product's own entry Sb St + Sa Cb Ct."""
    beta, alpha, d, theta, r, gain, runout_cos, runout_sin = link
    q = q + gain * q
    if prismatic:
        r += q
    else:
        theta += q
        r += runout_cos * np.cos(q) + runout_sin * np.sin(q)
    sb, cb, sa, ca, st, ct = (f(x) for x in (beta, alpha, theta) for f in (np.sin, np.cos))
    return np.array(
        [
            [cb * ct + sb * sa * st, sb * sa * ct - cb * st, sb * ca, d * cb + r * sb * ca],
            [ca * st, ca * ct, -sa, -r * sa],
            [sa * cb * st - sb * ct, sb * st + sa * cb * ct, cb * ca, r * cb * ca - d * sb],
            [0, 0, 0, 1],
        ]
    )


def written_mirror(vector: np.ndarray) -> np.ndarray:
    """Paper equation (14)."""
    b, t, z = (vector[EXTRINSICS.index(name) - 8] for name in ("beta_et", "theta_et", "z_et"))
    sb, cb, st, ct = np.sin(b), np.cos(b), np.sin(t), np.cos(t)
    return np.array([[ct, 0, st, 0], [sb * st, cb, -sb * ct, 0], [-cb * st, sb, cb * ct, z], [0, 0, 0, 1]])


def written_fibre(vector: np.ndarray) -> np.ndarray:
    """Paper equation (13)."""
    b, t, x, y, z = (vector[EXTRINSICS.index(n) - 8] for n in ("beta_wf", "theta_wf", "x_wf", "y_wf", "z_wf"))
    sb, cb, st, ct = np.sin(b), np.cos(b), np.sin(t), np.cos(t)
    return np.array([[ct, -st, 0, x], [cb * st, cb * ct, -sb, y], [sb * st, sb * ct, cb, z], [0, 0, 0, 1]])


def written_mirror_pose(cell: Cell, vector: np.ndarray, q: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for i, joint in enumerate(cell.joints):
        pose = pose @ written_link(vector[8 * i : 8 * i + 8].copy(), q[i], joint.kind == "prismatic")
    return pose @ written_mirror(vector)


def written_length(cell: Cell, vector: np.ndarray, q: np.ndarray) -> float:
    """Plane and line formulas (21) to (25): a x + b y + c z + d = 0 meets f + L (a_wf, b_wf, c_wf)."""
    mirror, fibre = written_mirror_pose(cell, vector, q), written_fibre(vector)
    a, b, c = mirror[0, 2], mirror[1, 2], mirror[2, 2]
    d = -a * mirror[0, 3] - b * mirror[1, 3] - c * mirror[2, 3]
    x, y, z = fibre[:3, 3]
    if cell.opd == "perpendicular":
        return abs(a * x + b * y + c * z + d) / np.sqrt(a * a + b * b + c * c)
    a_wf, b_wf, c_wf = fibre[:3, 2] if cell.optical_axis == "z" else -fibre[:3, 1]
    return -(a * x + b * y + c * z + d) / (a * a_wf + b * b_wf + c * c_wf)


@given(random_cells())
def test_mirror_pose_is_the_written_product(random: RandomCell) -> None:
    for q in random.poses:
        expected = written_mirror_pose(random.cell, random.vector, q)
        assert_allclose(chain.mirror_pose(random.cell, random.vector, q), expected, rtol=0, atol=1e-11)


@given(random_cells())
def test_fibre_is_the_written_matrix(random: RandomCell) -> None:
    assert_allclose(chain.fibre_in_world(random.vector), written_fibre(random.vector), rtol=0, atol=1e-14)


@given(random_cells())
def test_lengths_follow_the_plane_formulas(random: RandomCell) -> None:
    written = np.array([written_length(random.cell, random.vector, q) for q in random.poses])
    assert_allclose(random.lengths, written, rtol=0, atol=random.tolerance)
    rows = random.model.pose_rows(random.poses)
    assert_allclose(random.model.predict(random.values, rows), written, rtol=0, atol=random.tolerance)


@given(random_cells())
def test_rotations_are_rotations(random: RandomCell) -> None:
    for q in random.poses:
        for pose in (chain.tool_pose(random.cell, random.vector, q), chain.fibre_in_world(random.vector)):
            rotation = pose[:3, :3]
            assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-14)
            assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)
            assert pose[3].tolist() == [0, 0, 0, 1]


@given(random_cells())
def test_reflection_point_lies_on_mirror_and_path(random: RandomCell) -> None:
    for q in random.poses:
        point, on_mirror = chain.reflection_point(random.cell, random.vector, q)
        fibre, mirror = chain.fibre_in_world(random.vector), chain.mirror_pose(random.cell, random.vector, q)
        perpendicular = random.cell.opd == "perpendicular"
        along = mirror[:3, 2] if perpendicular else chain.optical_axis(random.cell, random.vector)
        length = path_length(random.cell, random.vector, q)
        assert on_mirror[2] == pytest.approx(0.0, abs=random.tolerance)
        travelled = (point - fibre[:3, 3]) @ along
        assert (abs(travelled) if perpendicular else travelled) == pytest.approx(length, abs=random.tolerance)
        assert_allclose(np.cross(point - fibre[:3, 3], along), 0.0, atol=random.tolerance)
        assert_allclose(mirror[:3, :3] @ on_mirror + mirror[:3, 3], point, rtol=0, atol=random.tolerance)


def test_reference_geometry(femto: Cell, case_a: ReferenceCase) -> None:
    vector, zero = np.zeros(len(femto.parameters)), np.zeros(6)
    vector[femto.free.slots] = case_a.truth(femto)
    # The held parameters of the built-in cell are all zero.
    assert not np.delete(femto.parameters.nominal, femto.free.slots).any()
    geometry = case_a.content["geometry_at_zero"]
    assert_allclose(chain.mirror_pose(femto, vector, zero), geometry["wTt"], rtol=0, atol=1e-12)
    perpendicular = femto.with_opd("perpendicular")
    assert path_length(femto, vector, zero) == pytest.approx(geometry["L_axis_um"], abs=1e-10)
    assert path_length(perpendicular, vector, zero) == pytest.approx(geometry["L_perpendicular_um"], abs=1e-10)
    world, on_mirror = chain.reflection_point(femto, vector, zero)
    assert_allclose(world, geometry["wPr_um"], rtol=0, atol=1e-10)
    assert_allclose(on_mirror, geometry["tPr_um"], rtol=0, atol=1e-10)


def test_nominal_cell_at_zero(femto: Cell) -> None:
    """q1, q2, q3 move along Zw, Yw, Xw; q4, q5, q6 turn about Xw, Zw, Yw; the mirror looks along Yw."""
    vector, zero = femto.parameters.nominal, np.zeros(6)
    rest = chain.tool_pose(femto, vector, zero)
    assert_allclose(rest, chain.rot_x(-np.pi / 2), atol=1e-15)
    for joint, direction in ((0, [0, 0, 1]), (1, [0, 1, 0]), (2, [1, 0, 0])):
        moved = chain.tool_pose(femto, vector, 7.0 * np.eye(6)[joint])
        assert_allclose(moved[:3, 3], 7.0 * np.array(direction), atol=1e-14)
        assert_allclose(moved[:3, :3], rest[:3, :3], atol=1e-15)
    for joint, turn in ((3, chain.rot_x), (4, chain.rot_z), (5, chain.rot_y)):
        assert_allclose(chain.tool_pose(femto, vector, 0.3 * np.eye(6)[joint]), turn(0.3) @ rest, atol=1e-15)
    assert_allclose(chain.optical_axis(femto, vector), [0, -1, 0], atol=1e-15)
    assert path_length(femto, vector, zero) == pytest.approx(920.0, abs=1e-12)


def test_literal_optical_axis_stands_across_the_mirror_normal(femto: Cell) -> None:
    """The third column of (13), which the paper names, is 90 degrees from the normal."""
    frame = chain.fibre_in_world(femto.parameters.nominal)
    normal = chain.mirror_pose(femto, femto.parameters.nominal, np.zeros(6))[:3, 2]
    assert normal @ frame[:3, 2] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("stem", LINK_SLOTS)
def test_link_of_one_parameter(stem: str) -> None:
    """Each of a link's numbers does what its name says."""
    link = np.zeros(8)
    link[LINK_SLOTS.index(stem)] = 0.1
    q = 0.4
    expected = {
        "beta": chain.rot_y(0.1) @ chain.rot_z(q),
        "alpha": chain.rot_x(0.1) @ chain.rot_z(q),
        "d": chain.translation(0.1, 0, 0) @ chain.rot_z(q),
        "theta": chain.rot_z(q + 0.1),
        "r": chain.translation(0, 0, 0.1) @ chain.rot_z(q),
        "gain": chain.rot_z(1.1 * q),
        "runout_cos": chain.translation(0, 0, 0.1 * np.cos(q)) @ chain.rot_z(q),
        "runout_sin": chain.translation(0, 0, 0.1 * np.sin(q)) @ chain.rot_z(q),
    }[stem]
    assert_allclose(chain.link_transform(link, q, prismatic=False), expected, atol=1e-16)
