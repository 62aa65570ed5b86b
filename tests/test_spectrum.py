import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fpcal_bayes.infer.fit.spectrum import spectrum_of, statuses


def with_spectrum(values: list[float], n_rows: int, seed: int = 0) -> np.ndarray:
    """A matrix (n_rows, n) with these singular values and random directions."""
    random = np.random.default_rng(seed)
    n = len(values)
    left = np.linalg.qr(random.standard_normal((n_rows, n)))[0][:, : min(n, n_rows)]
    right = np.linalg.qr(random.standard_normal((n, n)))[0]
    return (left * np.array(values)[: left.shape[1]]) @ right[: left.shape[1]]


@given(
    exponents=st.lists(st.floats(-4, 4), min_size=1, max_size=8), n_null=st.integers(0, 3), seed=st.integers(0, 1000)
)
def test_rank_gap_and_null_space(exponents, n_null, seed):
    values = sorted(10.0 ** np.array(exponents), reverse=True)
    n = len(values) + n_null
    matrix = with_spectrum([*values, *[0.0] * n_null], n + 5, seed)
    spectrum = spectrum_of(matrix)
    assert spectrum.rank == len(values)
    np.testing.assert_allclose(spectrum.singular_values[: spectrum.rank], values, rtol=1e-6)
    assert spectrum.observable.shape == (len(values), n)
    assert spectrum.null_space.shape == (n_null, n)
    np.testing.assert_allclose(spectrum.directions @ spectrum.directions.T, np.eye(n), atol=1e-12)
    assert np.abs(matrix @ spectrum.null_space.T).max(initial=0.0) < 1e-11 * values[0]
    np.testing.assert_allclose(spectrum.null_share, np.diag(spectrum.null_space.T @ spectrum.null_space), atol=1e-12)
    assert spectrum.null_share.sum() == pytest.approx(n_null, abs=1e-9)
    assert spectrum.gap > 1e3


def test_gap_is_infinite_at_full_rank():
    assert spectrum_of(with_spectrum([3.0, 2.0], 4)).gap == np.inf


@pytest.mark.parametrize("n_rows", [1, 2, 5])
def test_fewer_rows_than_parameters(n_rows):
    spectrum = spectrum_of(np.random.default_rng(0).standard_normal((n_rows, 6)))
    assert spectrum.rank == n_rows
    assert spectrum.directions.shape == (6, 6)
    assert spectrum.singular_values.shape == (6,)


def test_nothing_is_seen():
    spectrum = spectrum_of(np.zeros((4, 3)))
    assert spectrum.rank == 0
    np.testing.assert_allclose(spectrum.null_share, 1.0, rtol=1e-12)


def test_tiny_values_beside_a_large_one_count_until_rounding_hides_them():
    assert spectrum_of(with_spectrum([1e4, 1.0, 2e-5], 9)).rank == 3
    assert spectrum_of(with_spectrum([1e4, 1.0, 5e-6], 9)).rank == 2


def test_status():
    # The data see the first parameter, the sum of the second and third, and the fourth a little.
    jacobian = np.array([[100.0, 0, 0, 0], [0, 50.0, 50.0, 0], [0, 0, 0, 0.9]])
    spectrum = spectrum_of(jacobian)
    share = np.diag(np.linalg.inv(jacobian.T @ jacobian + np.eye(4)))
    assert statuses(spectrum.null_share, share) == ("identified", "gauge", "gauge", "weak")
    # At a singular value of one the variance is halved.
    jacobian[2, 3] = 1.1
    share = np.diag(np.linalg.inv(jacobian.T @ jacobian + np.eye(4)))
    assert statuses(spectrum_of(jacobian).null_share, share)[3] == "identified"


@pytest.mark.parametrize(("share", "expected"), [(0.09, "identified"), (0.11, "gauge")])
def test_a_gauge_has_a_tenth_of_the_null_space(share, expected):
    hidden = np.array([np.sqrt(share), np.sqrt(1 - share)])
    seen = np.array([hidden[1], -hidden[0]])
    spectrum = spectrum_of(100.0 * seen[None])
    np.testing.assert_allclose(spectrum.null_share, hidden**2, atol=1e-12)
    assert statuses(spectrum.null_share, np.array([0.2, 0.9])) == (expected, "gauge")
