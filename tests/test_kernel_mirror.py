"""Mirror normals and origins against columns three and four of the 4x4 product."""

import numpy as np
from conftest import RandomCell, random_cells
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from fpcal_bayes.model import chain


@given(random_cells())
def test_columns_of_the_mirror_pose(random: RandomCell) -> None:
    normals, origins = random.model.mirrors(random.values, random.poses)
    poses = np.array([chain.mirror_pose(random.cell, random.vector, q) for q in random.poses])
    assert_allclose(normals, poses[:, :3, 2], rtol=0, atol=1e-14)
    assert_allclose(origins, poses[:, :3, 3], rtol=0, atol=1e-11)


@given(random_cells(n_poses=3))
def test_many_vectors(random: RandomCell) -> None:
    many = np.array([random.values, 0.5 * random.values])
    normals, origins = random.model.mirrors(many, random.poses)
    assert normals.shape == origins.shape == (2, 3, 3)
    for vector, normal, origin in zip(many, normals, origins, strict=True):
        alone = random.model.mirrors(vector, random.poses)
        assert_array_equal(normal, alone[0])
        assert_array_equal(origin, alone[1])
    assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, rtol=0, atol=1e-14)
