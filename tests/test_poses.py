"""How poses are grouped for the kernels."""

import numpy as np
import pytest
from conftest import RandomCell, ReferenceCase, random_cells
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from fpcal_bayes.model.cavity import group_poses
from fpcal_bayes.model.cell.cell import Cell


@given(random_cells(n_poses=6), st.lists(st.integers(0, 5), min_size=1, max_size=20))
def test_layout(random: RandomCell, picks: list[int]) -> None:
    cell, given_q = random.cell, random.poses[picks]
    poses = group_poses(cell, given_q)
    group_of_pose = np.repeat(np.arange(len(poses.group_q)), np.diff(poses.group_start))
    q = poses.group_q[group_of_pose]
    q[:, ~cell.revolute] = poses.prismatic_q
    assert_array_equal(q[poses.inverse], given_q)
    assert len(np.unique(q, axis=0)) == len(q)
    assert len(np.unique(poses.group_q, axis=0)) == len(poses.group_q)
    assert poses.group_start[0] == 0
    assert poses.group_start[-1] == len(q)
    assert (np.diff(poses.group_start) > 0).all()
    assert (poses.group_q[:, ~cell.revolute] == 0.0).all()
    assert_array_equal(poses.group_cos, np.cos(poses.group_q))
    assert_array_equal(poses.group_sin, np.sin(poses.group_q))


def test_paper_sweeps_have_few_groups(femto: Cell, case_a: ReferenceCase) -> None:
    """138 poses share 10 distinct orientations; counted apart from the code under test."""
    q = np.concatenate([case_a.q_start, case_a.q_end])
    assert len(q) == 138
    assert len(group_poses(femto, q).group_q) == len({tuple(turns) for turns in q[:, 3:].tolist()})


def test_minus_zero_is_zero(femto: Cell) -> None:
    poses = group_poses(femto, np.array([[0.0] * 6, [-0.0] * 6]))
    assert len(poses.prismatic_q) == len(poses.group_q) == 1


def test_no_poses(femto: Cell) -> None:
    poses = group_poses(femto, np.zeros((0, 6)))
    assert len(poses.prismatic_q) == len(poses.group_q) == len(poses.inverse) == 0
    assert poses.group_start.tolist() == [0]


@pytest.mark.parametrize("shape", [(6,), (2, 5), (2, 7), (1, 2, 6)])
def test_wrong_shape(femto: Cell, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected"):
        group_poses(femto, np.zeros(shape))
