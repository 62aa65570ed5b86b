"""Tasks: their definitions, held to the readable model, and their ends."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from path_length import path_length
from task_fixtures import paper_values

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.joint_paths import read_path
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.placement import Placement
from fpcal_bayes.motion.tasks import TASKS, find_task, follow_offsets, task_path, user_path

HEADER = "x_um,y_um,z_um,rx_deg,ry_deg,rz_deg\n"


def vector_of(cell: Cell) -> np.ndarray:
    return CavityModel.of(cell).vector(paper_values(cell))


def mirror_in_fibre(cell: Cell, vector: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mirror orientation and the point tPr (of joint vector zero) in the fibre frame, by 4x4 products."""
    _, point = chain.reflection_point(cell, vector, np.zeros(6))
    pose = np.linalg.inv(chain.fibre_in_world(vector)) @ chain.mirror_pose(cell, vector, q)
    return pose[:3, :3], (pose @ np.append(point, 1.0))[:3]


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_aligned_pose(femto: Cell, opd: str) -> None:
    """The mirror normal stands along +Yf, Xt along Xf, and the mirror point has not moved."""
    cell = femto.with_opd(opd)
    vector = vector_of(cell)
    start = task_path(cell, vector, "circle").start
    rotation, point = mirror_in_fibre(cell, vector, start)
    assert_allclose(rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], rtol=0, atol=1e-12)
    assert_allclose(point, mirror_in_fibre(cell, vector, np.zeros(6))[1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_tasks_follow_their_definitions(femto: Cell, opd: str) -> None:
    cell = femto.with_opd(opd)
    vector = vector_of(cell)
    aligned, origin = mirror_in_fibre(cell, vector, task_path(cell, vector, "circle").start)
    for name in TASKS:
        task = task_path(cell, vector, name, radius=80.0, n_points=9)
        assert task.name == name
        assert len(task) == 9
        assert task.q.shape == (9, 6)
        for t, q in zip(task.along, task.q, strict=True):
            rotation, point = mirror_in_fibre(cell, vector, q)
            turn, shift = chain.rot_x(0.0), np.zeros(3)
            if name == "circle":
                shift = 80.0 * np.array([np.cos(np.radians(t)), 0.0, np.sin(np.radians(t))])
            elif name.startswith("line"):
                shift["xyz".index(name[-1])] = t
            else:
                turn = {"tilt-x": chain.rot_x, "tilt-z": chain.rot_z, "spin": chain.rot_y}[name](np.radians(t))
            assert_allclose(point, origin + shift, rtol=0, atol=1e-7)
            assert_allclose(rotation, turn[:3, :3] @ aligned, rtol=0, atol=1e-10)
    assert task_path(cell, vector, "line-x").along[[0, -1]].tolist() == [-150.0, 150.0]
    assert_allclose(task_path(cell, vector, "tilt-z").along[[0, -1]], [-3.0, 3.0])


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
@pytest.mark.parametrize("name", TASKS)
def test_perfect_parameters_leave_no_error(femto: Cell, opd: str, name: str) -> None:
    """Below 1e-6 nm; on the axis path the cavity length itself is constant, by 4x4 products."""
    cell = femto.with_opd(opd)
    vector = vector_of(cell)
    task = task_path(cell, vector, name)
    lengths = np.array([path_length(cell, vector, q) for q in task.q])
    rows = CavityModel.of(cell).pose_rows(task.q)
    assert_allclose(CavityModel.of(cell).predict(paper_values(cell), rows), lengths, rtol=0, atol=1e-9)
    if opd == "axis" or not name.startswith("tilt"):
        assert np.ptp(lengths) * 1e3 < 1e-6
    else:
        # The distance from the fibre end to a mirror that turns about its far point shrinks with the cosine.
        expected = lengths[30] * (np.cos(np.radians(task.along)) - 1.0)
        assert_allclose(lengths - lengths[30], expected, rtol=0, atol=0.2)


def test_spin_ends_at_the_first_limit(femto: Cell) -> None:
    vector = vector_of(femto)
    task = task_path(femto, vector, "spin", n_points=11)
    assert task.ok.all()
    travel = np.abs(task.q[[0, -1], :3]).max(axis=1)
    assert_allclose(travel, 150.0, rtol=0, atol=1e-5)
    assert (np.abs(task.q[1:-1, :3]) < 150.0).all()
    beyond = np.zeros((2, 6))
    beyond[:, 4] = np.radians(task.along[[0, -1]]) * (1 + 1e-6)
    assert not follow_offsets(femto, vector, "beyond", beyond).ok.any()
    # A joint file must not ask for more than a joint has, be it by a rounding error.
    assert ((task.q >= femto.low) & (task.q <= femto.high)).all()


def test_spin_ends_at_a_quarter_turn_where_no_joint_stops_it(femto: Cell) -> None:
    task = task_path(femto, femto.parameters.nominal, "spin")
    assert_allclose(task.along[[0, -1]], [-90.0, 90.0], rtol=0, atol=0)


def test_lines_that_saturate_say_so(femto: Cell) -> None:
    task = task_path(femto, vector_of(femto), "line-x")
    assert task.status[-1] == "saturated: q3 at its upper limit 150 um (153.159 um wanted)"
    assert task.finite.all()
    assert not task.ok.all()
    assert task.take(task.ok).ok.all()
    driven = task.driven()
    assert driven.ok.all()
    assert len(driven) == task.ok.sum() < len(task)
    with pytest.raises(InputError, match="no point can be driven to; point 1: saturated"):
        task.take(~task.ok).driven()


def test_unusable_commands_are_refused(femto: Cell) -> None:
    vector = femto.parameters.nominal
    for arguments, message in (
        ({"name": "square"}, "unknown task 'square': expected one of circle, line-x"),
        ({"name": "circle", "radius": -1.0}, "radius -1 um: expected a number above zero"),
        ({"name": "circle", "radius": float("nan")}, "expected a number above zero"),
        ({"name": "spin", "n_points": 1}, "with 1 points: expected at least two"),
    ):
        with pytest.raises(InputError, match=message):
            task_path(femto, vector, **arguments)
    tilted = vector.copy()
    tilted[femto.parameters["beta_et"].slot] = np.radians(8.0)
    with pytest.raises(InputError, match="the aligned pose cannot be reached with this estimate: saturated: q4"):
        task_path(femto, tilted, "spin")


def test_user_path(femto: Cell, tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text(HEADER + "0,0,0,0,0,0\n10,-2,5,1,2,-1.5\n")
    vector = vector_of(femto)
    task = find_task(femto, vector, str(file))
    assert task.name == "path.csv"
    assert task.unit == "point"
    assert task.ok.all()
    assert_allclose(task.q[0], task.start, rtol=0, atol=1e-9)
    aligned, origin = mirror_in_fibre(femto, vector, task.start)
    rotation, point = mirror_in_fibre(femto, vector, task.q[1])
    x, y, z = np.radians([1.0, 2.0, -1.5])
    turn = chain.rot_z(z) @ chain.rot_y(y) @ chain.rot_x(x)
    assert_allclose(rotation, turn[:3, :3] @ aligned, rtol=0, atol=1e-10)
    assert_allclose(point, origin + np.array([10.0, -2.0, 5.0]), rtol=0, atol=1e-7)
    poses = Placement.of(femto, vector).mirror_poses(np.array([chain.tool_pose(femto, vector, q) for q in task.q]))
    assert_allclose(poses, task.poses, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "0,0,0,0,0,0\n", "1 row, expected a path of two or more"),
        (HEADER, "0 rows, expected a path of two or more"),
        ("x,y,z\n1,2,3\n", "row 1: expected the header x_um,y_um"),
        (HEADER + "0,0,0,0,0\n", "row 2: expected 6 fields, found 5"),
        (HEADER + "0,0,0,0,0,0\n0,0,nan,0,0,0\n", "row 3, column z_um: expected a finite number, found 'nan'"),
        (HEADER + "0,0,0,0,0,0\n0,0,0,0,0,1e999\n", "row 3, column rz_deg: expected a finite number"),
        (HEADER + "0,0,0,,0,0\n", "row 2, column rx_deg: expected a finite number, found nothing"),
        (HEADER + '"0,0\n', "not a line of CSV"),
        ("\n\n", "the file holds no text"),
    ],
)
def test_bad_paths_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_path(file)


def test_a_pose_far_away_is_named(femto: Cell, tmp_path: Path) -> None:
    file = tmp_path / "far.csv"
    file.write_text(HEADER + "0,0,0,0,0,0\n0,900,0,0,0,0\n")
    task = user_path(femto, femto.parameters.nominal, file)
    assert task.status.tolist() == ["ok", "saturated: q2 at its upper limit 150 um (900 um wanted)"]
