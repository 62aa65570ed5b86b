"""What a choice of candidates leaves, against the plain formula; criteria, greedy search and exchange."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.infer.design.criteria import CRITERIA, criterion_by_name
from fpcal_bayes.infer.design.exchange import exchange, greedy, most_useful_first
from fpcal_bayes.infer.design.information import Design

KEYS = sorted(CRITERIA)


def random_case(seed: int, candidates: int = 7, n: int = 4, k: int = 2) -> dict:
    random = np.random.default_rng(seed)
    half = random.normal(size=(n, n))
    return {
        "rows": random.normal(size=(3, candidates, k, n)) * random.choice([0.3, 3.0, 30.0], size=(candidates, 1, 1)),
        "tasks": {"a": random.normal(size=(3, 5, n)), "b": 10 * random.normal(size=(3, 2, n))},
        "covariance": half @ half.T,
        "known": random.normal(size=(3, 2, n)),
    }


def posterior(case: dict, draw: int, chosen: tuple[int, ...]) -> np.ndarray:
    """Covariance by inverting the information."""
    rows = [case["known"][draw], *(case["rows"][draw, c] for c in chosen)]
    information = np.linalg.inv(case["covariance"]) + sum(part.T @ part for part in rows)
    return np.linalg.inv(information)


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), k=st.integers(1, 4))
def test_variances_by_inverting_the_information(seed: int, k: int) -> None:
    case = random_case(seed, k=k)
    design = Design.of(**case)
    expected = []
    for c in range(7):
        left = [posterior(case, draw, (2, 5, c)) for draw in range(3)]
        both = []
        for name in ("a", "b"):
            variances = [np.diag(t @ p @ t.T) for t, p in zip(case["tasks"][name], left, strict=True)]
            both.append([np.mean([v.max() for v in variances]), np.mean([v.mean() for v in variances])])
        expected.append(both)
        np.testing.assert_allclose(design.expected_variance((2, 5, c)), np.array(both)[:, 0], rtol=1e-6)
    worst, gain = design.if_added((2, 5))
    mean, _ = design.if_added((2, 5), worst=False)
    np.testing.assert_allclose(worst, np.array(expected)[:, :, 0], rtol=1e-6)
    np.testing.assert_allclose(mean, np.array(expected)[:, :, 1], rtol=1e-6)
    ratio = [
        np.mean(
            [
                np.log(np.linalg.det(posterior(case, d, (2, 5))) / np.linalg.det(posterior(case, d, (2, 5, c))))
                for d in range(3)
            ]
        )
        for c in range(7)
    ]
    np.testing.assert_allclose(gain, ratio, rtol=1e-6, atol=1e-9)
    some = np.array([4, 1])
    np.testing.assert_allclose(design.if_added((2, 5), some)[0], worst[some], rtol=1e-9)


@pytest.mark.parametrize("name", KEYS)
def test_candidate_values_are_those_of_the_choice_with_it(name: str) -> None:
    design = Design.of(**random_case(1))
    criterion = criterion_by_name(name, design, np.array([1.0, 2.0]))
    added = criterion.if_added((3,), None)
    np.testing.assert_allclose(added, [criterion.value((3, c)) for c in range(7)], rtol=1e-6)
    np.testing.assert_allclose(criterion.if_added((3,), np.array([6, 0])), added[[6, 0]], rtol=1e-9)


def test_parameter_criteria_by_eigenvalues() -> None:
    case = random_case(2) | {"covariance": np.eye(4)}
    design = Design.of(**case)
    left = [np.linalg.eigvalsh(posterior(case, draw, (0, 1))) for draw in range(3)]
    one = np.ones(2)
    assert criterion_by_name("A", design, one).value((0, 1)) == pytest.approx(np.mean([v.mean() for v in left]))
    assert criterion_by_name("D", design, one).value((0, 1)) == pytest.approx(np.mean([np.log(v).sum() for v in left]))
    assert criterion_by_name("E", design, one).value((0, 1)) == pytest.approx(np.mean([v[-1] for v in left]))


def test_o1_orders_as_the_product_of_singular_values() -> None:
    """Three directions seen of four; what the prior says of them plays no part."""
    random = np.random.default_rng(0)
    basis = np.linalg.qr(random.normal(size=(4, 3)))[0]
    rows = random.normal(size=(1, 6, 3, 3)) @ basis.T
    rows *= np.array([0.3, 1.0, 0.5, 3.0, 0.8, 10.0])[:, None, None]
    design = Design.of(rows, {"a": random.normal(size=(1, 2, 4))})
    found = criterion_by_name("O1", design, np.ones(1)).if_added((), None)
    product = [np.log(np.linalg.svd(part, compute_uv=False)[:3]).sum() for part in rows[0]]
    assert np.ptp(found + 2 * np.array(product)) < 1e-2


@pytest.mark.parametrize("name", KEYS)
def test_exchange_finds_no_worse_than_greedy_and_nearly_the_best(name: str) -> None:
    for seed in range(4):
        criterion = criterion_by_name(name, Design.of(**random_case(seed, candidates=9)), np.array([1.0, 5.0]))
        first = greedy(criterion, 3)
        found = exchange(criterion, first, passes=5)
        best = min(criterion.value(chosen) for chosen in combinations(range(9), 3))
        assert len(set(found)) == 3
        assert criterion.value(found) <= criterion.value(first) + 1e-12
        # No single exchange helps any more.
        for place in range(3):
            others = found[:place] + found[place + 1 :]
            values = criterion.if_added(others, np.array([c for c in range(9) if c not in others]))
            assert values.min() >= criterion.value(found) - 1e-3 * abs(criterion.value(found))
        assert best <= criterion.value(found) + 1e-9
        assert sorted(most_useful_first(criterion, found)) == sorted(found)


@given(st.integers(0, 10**6), st.integers(0, 4))
def test_root_of_a_singular_covariance(seed: int, rank: int) -> None:
    random = np.random.default_rng(seed)
    half = random.normal(size=(4, rank)) * 10.0 ** random.integers(-4, 4, size=(4, 1))
    covariance = half @ half.T
    root = covariance_root(covariance)
    size = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert (np.abs(root @ root.T - covariance) <= 1e-12 * size + 1e-300).all()


def test_unknown_criterion() -> None:
    with pytest.raises(InputError, match="unknown criterion 'X': expected one of worst, I"):
        criterion_by_name("X", Design.of(**random_case(0)), np.ones(2))
