"""What a choice of candidates leaves, against the plain formula; criteria, greedy search and exchange."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.infer.design.exchange import exchange, greedy, most_useful_first
from fpcal_bayes.infer.design.information import Criterion, Design


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
@given(seed=st.integers(0, 10**6), k=st.integers(1, 4), n=st.sampled_from([4, 16]))
def test_variances_by_inverting_the_information(seed: int, k: int, n: int) -> None:
    """Whether the chosen rows are few beside the unknowns or many."""
    case = random_case(seed, k=k, n=n)
    design = Design.of(**case)
    if n > 4:
        # With nothing known, few rows are a system of their own number.
        design, case["known"] = Design.of(**case | {"known": None}), case["known"][:, :0]
    expected = []
    for c in range(7):
        left = [posterior(case, draw, (2, 5, c)) for draw in range(3)]
        both = []
        for name in ("a", "b"):
            variances = [np.diag(t @ p @ t.T) for t, p in zip(case["tasks"][name], left, strict=True)]
            both.append([np.mean([v.max() for v in variances]), np.mean([v.mean() for v in variances])])
        expected.append(both)
        np.testing.assert_allclose(design.expected_variance((2, 5, c)), np.array(both)[:, 0], rtol=1e-6)
    worst = design.if_added((2, 5))
    mean = design.if_added((2, 5), worst=False)
    np.testing.assert_allclose(worst, np.array(expected)[:, :, 0], rtol=1e-6)
    np.testing.assert_allclose(mean, np.array(expected)[:, :, 1], rtol=1e-6)


@pytest.mark.parametrize("mean", [False, True])
def test_candidate_values_are_those_of_the_choice_with_it(mean: bool) -> None:
    design = Design.of(**random_case(1))
    criterion = Criterion(design, np.array([1.0, 2.0]), mean)
    added = criterion.if_added((3,))
    np.testing.assert_allclose(added, [criterion.value((3, c)) for c in range(7)], rtol=1e-6)


@pytest.mark.parametrize("k", [1, 2, 4])
def test_worst_points_by_small_and_by_large_systems(k: int) -> None:
    """Few rows against twelve unknowns are solved in their own number, many in that of the unknowns."""
    for known in (None, np.random.default_rng(5).normal(size=(3, 2, 12))):
        case = random_case(3, k=k, n=12) | {"known": known}
        design = Design.of(**case)
        for chosen in ((4,), (1, 4, 2)):
            variance, directions = design.worst_points(chosen)
            roots = design.roots(chosen)
            every = design.task_variance(chosen)
            for task in range(2):
                points = np.flatnonzero(design.task_of_point == task)
                worst = points[every[:, points].argmax(axis=1)]
                np.testing.assert_allclose(variance[:, task], every[:, points].max(axis=1), rtol=1e-8)
                by_root = [
                    root @ (root.T @ design.tasks[d, p]) for d, (root, p) in enumerate(zip(roots, worst, strict=True))
                ]
                np.testing.assert_allclose(directions[:, task], by_root, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("mean", [False, True])
def test_exchange_finds_no_worse_than_greedy_and_nearly_the_best(mean: bool) -> None:
    for seed in range(4):
        criterion = Criterion(Design.of(**random_case(seed, candidates=9)), np.array([1.0, 5.0]), mean)
        first = greedy(criterion, 3)
        found = exchange(criterion, first, passes=5)
        best = min(criterion.value(chosen) for chosen in combinations(range(9), 3))
        assert len(set(found)) == 3
        assert criterion.value(found) <= criterion.value(first) + 1e-12
        # No single exchange helps any more.
        for place in range(3):
            others = found[:place] + found[place + 1 :]
            values = criterion.if_added(others)[[c for c in range(9) if c not in others]]
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


@pytest.mark.parametrize("size", [1e6, 1e8])
@pytest.mark.parametrize("known", [False, True])
def test_rows_far_above_the_identity(size: float, known: bool) -> None:
    """Rows that say again what others said leave what both leave, however little noise they have."""
    case = random_case(4, n=16) | {"covariance": None}
    case["rows"][:, 3] = case["rows"][:, 2] * (1.0 + 1e-9)
    case["rows"] *= size
    case["known"] = size * np.random.default_rng(5).normal(size=(3, 2, 16)) if known else None
    design = Design.of(**case)
    # Few rows beside the unknowns, and many.
    for chosen in ((2, 5), (2, 5, 0, 1, 4)):
        expected = [design.expected_variance((*chosen, c)) for c in range(7)]
        np.testing.assert_allclose(design.if_added(chosen), expected, rtol=1e-4)
        variance, directions = design.worst_points(chosen)
        np.testing.assert_allclose(variance.mean(axis=0), design.expected_variance(chosen), rtol=1e-6)
        # Covariance times a point's derivatives, of which the point's variance is made.
        products = (design.tasks[:, None] * directions[:, :, None]).sum(axis=-1)
        assert (np.abs(products - variance[..., None]).min(axis=-1) <= 1e-6 * variance).all()
