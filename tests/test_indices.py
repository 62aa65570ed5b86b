"""Observability indices on cases computed by hand."""

import numpy as np
import pytest

from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.observability.measures import indices_of


def test_indices_of_a_case_by_hand():
    # Singular values 8, 4, 1 in four rows, and a parameter that nothing sees.
    jacobian = np.zeros((4, 4))
    jacobian[0, 0], jacobian[1, 1], jacobian[3, 2] = 4.0, -8.0, 1.0
    found = indices_of(spectrum_of(jacobian), 4)
    assert found.o1 == pytest.approx(32.0 ** (1 / 3) / 2.0)  # (8 * 4 * 1)^(1/3) / sqrt(4)
    assert found.o2 == pytest.approx(1 / 8)
    assert found.o3 == pytest.approx(1.0)
    assert found.o4 == pytest.approx(1 / 8)  # 1^2 / 8
    assert found.o5 == pytest.approx(8 / 11)  # 1 / (1/8 + 1/4 + 1)
    assert found.condition == pytest.approx(8.0)
    assert found.content() == {"O1": found.o1, "O2": found.o2, "O3": found.o3, "O4": found.o4, "O5": found.o5}


def test_indices_of_a_full_matrix_by_hand():
    # J'J = [[5, 4], [4, 5]] has the eigenvalues 9 and 1.
    found = indices_of(spectrum_of(np.array([[2.0, 1.0], [1.0, 2.0]])), 2)
    assert [found.o1, found.o2, found.o3, found.o4, found.o5] == pytest.approx(
        [np.sqrt(3.0) / np.sqrt(2.0), 1 / 3, 1.0, 1 / 3, 3 / 4]
    )


def test_less_noise_scales_o1_o3_o4_o5_and_leaves_o2():
    jacobian = np.random.default_rng(0).standard_normal((9, 4))
    plain, sharper = indices_of(spectrum_of(jacobian), 9), indices_of(spectrum_of(10 * jacobian), 9)
    assert sharper.o2 == pytest.approx(plain.o2)
    for name in ("o1", "o3", "o4", "o5"):
        assert getattr(sharper, name) == pytest.approx(10 * getattr(plain, name))


def test_nothing_seen_gives_zeros():
    found = indices_of(spectrum_of(np.zeros((3, 2))), 3)
    assert set(found.content().values()) == {0.0}
    assert found.condition == np.inf
