"""Robots of fewer than six joints: tasks in the directions that they have, and the whole way by the commands."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from path_length import path_length

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.new_cell import new_cell_text
from fpcal_bayes.model import chain
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.layout import layout_of_axes, read_axes, read_side
from fpcal_bayes.model.inverse import InverseModel
from fpcal_bayes.motion.tasks import NO_AXIS, TASKS, default_radius, find_task, half_line, half_tilt, possible_tasks

DATA = Path(__file__).parent / "data"
FIVE = load_cell(DATA / "five_axes.toml", mechanics="none")


def made(words: str, folder: Path, side: str = "+y") -> Cell:
    path = folder / "cell.toml"
    path.write_text(
        new_cell_text(layout_of_axes(read_axes(words), read_side(side), 300.0), "few", wavelength_nm=1550.0)
    )
    return load_cell(path, mechanics="none")


def drawn(cell: Cell, seed: int) -> np.ndarray:
    """A model vector away from nominal."""
    vector = cell.parameters.nominal.copy()
    sd = 0.3 * cell.free.prior_sd
    vector[cell.free.slots] += sd * np.random.default_rng(seed).standard_normal(len(cell.free))
    return vector


@pytest.mark.parametrize("seed", range(5))
def test_poses_that_the_robot_takes_are_found_again(seed):
    vector = drawn(FIVE, seed)
    q = np.random.default_rng(seed).uniform(-1, 1, (20, 5)) * [150, 150, 150, 0.08, 0.08]
    poses = np.array([chain.tool_pose(FIVE, vector, at) for at in q])
    found = InverseModel(FIVE).solve(vector, poses, near=np.zeros(5))
    assert found.ok.all()
    assert_allclose(found.q, q, atol=1e-5)


def test_what_five_axes_can_do():
    assert possible_tasks(FIVE) == ("circle", "line-x", "line-z", "tilt-x", "tilt-z")
    spin = find_task(FIVE, FIVE.parameters.nominal, "spin")
    assert set(spin.status[spin.along != 0]) == {NO_AXIS}


@pytest.mark.parametrize("task", ["circle", "tilt-x", "tilt-z"])
def test_the_mirror_goes_where_the_task_says(task):
    """By plain 4x4 products: the mirror point follows, and the length stays as on any controlled path."""
    vector = drawn(FIVE, 3)
    found = find_task(FIVE, vector, task, radius=50.0, n_points=13)
    assert found.ok.all()
    lengths = [path_length(FIVE, vector, q) for q in found.q]
    # The axis path: every task turns or moves the mirror about the point where the light meets it.
    assert np.ptp(lengths) < 1e-6
    normals = np.array([chain.mirror_pose(FIVE, vector, q)[:3, 2] for q in found.q])
    off = np.degrees(np.arccos(np.clip(-normals @ chain.optical_axis(FIVE, vector), -1, 1)))
    assert_allclose(off, 0.0 if task == "circle" else np.abs(np.linspace(-3, 3, 13)), atol=1e-4)


@pytest.mark.parametrize(
    ("words", "side", "expected"),
    [
        ("x y z", "+y", {"circle", "line-x", "line-z"}),
        ("y rx rz", "+y", {"tilt-x", "tilt-z"}),
        ("z x rz", "+z", {"line-x", "spin"}),
        ("x z ry", "minus-y", {"circle", "line-x", "line-z", "spin"}),
    ],
)
def test_directions_decide(words, side, expected, tmp_path):
    assert set(possible_tasks(made(words, tmp_path, side))) == expected


def test_tasks_scale_to_the_limits(femto):
    assert (half_line(femto), default_radius(femto), np.degrees(half_tilt(femto))) == pytest.approx((150, 100, 3))
    lab7 = load_cell(DATA / "lab7.toml", mechanics="none")
    assert (half_line(lab7), default_radius(lab7)) == pytest.approx((45.0, 30.0))
    for task in TASKS:
        assert find_task(lab7, lab7.parameters.nominal, task, radius=default_radius(lab7)).ok.all()


@pytest.mark.slow
def test_two_axes_go_the_whole_way(tmp_path):
    cell, truth, rows = (tmp_path / name for name in ("cell.toml", "truth.toml", "rows.csv"))
    new = ["cell", "--new", "rx -z", "--gap-um", "300", "--gap-sd-um", "5", "-o", str(cell), "--quiet"]
    assert main(new) == 0
    free = load_cell(cell, mechanics="none").free
    values = free.nominal + 0.5 * free.prior_sd * np.random.default_rng(1).standard_normal(len(free))
    named = zip(free.names, free.to_shown(values).tolist(), strict=True)
    truth.write_text("[parameters]\n" + "".join(f"{name} = {value!r}\n" for name, value in named))

    def fpcal(command: str, *arguments: object) -> None:
        assert main([command, "--cell", str(cell), "--quiet", *map(str, arguments)]) == 0

    quick = ("--draws", 8, "--candidates", 150, "--radius-um", 60)
    fpcal("plan", "--n", 14, *quick, "-o", tmp_path / "plan.csv", "--rows", rows)
    fpcal("simulate", "--protocol", rows, "--truth", truth, "-o", tmp_path / "sweeps.csv")
    fpcal("identify", tmp_path / "sweeps.csv", "--json", tmp_path / "estimate.json")
    fpcal("task-error", tmp_path / "estimate.json", "--radius-um", 60, "--json", tmp_path / "task.json")
    tasks = json.loads((tmp_path / "task.json").read_text())["tasks"]
    assert set(tasks) == set(possible_tasks(load_cell(cell, mechanics="none")))
