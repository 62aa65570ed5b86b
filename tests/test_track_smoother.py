"""The iterated smoother against a general least-squares program that moves the whole trajectory at once."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from track_fixtures import CELL, campaign, knock

from fpcal_bayes.tracking.smoother import smooth
from fpcal_bayes.tracking.tracker import track


def root_of(matrix: np.ndarray) -> np.ndarray:
    """A square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.clip(values, 0.0, None))


@pytest.fixture(scope="module", params=["as modelled", "knock"])
def followed(request):
    change = None if request.param == "as modelled" else knock(np.random.default_rng(0))
    return track(CELL, campaign(3, sessions=3, hours=20.0, change=change, changed=2)[1])


def test_the_trajectory_is_the_maximum_of_its_posterior(followed):
    outcomes, drift = followed.outcomes, followed.drift
    roots = [np.eye(drift.n_states)]
    for before, outcome in pairwise(outcomes):
        roots.append(root_of(drift.transition(outcome.time_h - before.time_h).noise + np.diag(outcome.jump**2)))

    def trajectory(scores: np.ndarray) -> np.ndarray:
        moves = [root @ part for root, part in zip(roots, np.split(scores, len(roots)), strict=True)]
        return np.cumsum(moves, axis=0)

    def residuals(scores: np.ndarray) -> np.ndarray:
        states = trajectory(scores)
        rows = [outcome.measurement.misfit(state) for outcome, state in zip(outcomes, states, strict=True)]
        return np.concatenate([scores, *rows])

    begin = np.concatenate([outcomes[0].state.mean, np.zeros((len(roots) - 1) * drift.n_states)])
    found = least_squares(residuals, begin, xtol=1e-12, ftol=1e-12, gtol=1e-10)
    smoothed = smooth(drift, outcomes)
    for state, mean in zip(smoothed.states, trajectory(found.x), strict=True):
        away = (state.mean - mean) / np.sqrt(np.diag(state.covariance))
        assert np.abs(away).max() < 0.03
    # At the maximum the covariance of all states together is the inverse of the normal matrix.
    joint = np.linalg.inv(found.jac.T @ found.jac)
    n = drift.n_states
    ways = [
        np.hstack([root if i <= k else np.zeros((n, n)) for i, root in enumerate(roots)]) for k in range(len(roots))
    ]
    for k, state in enumerate(smoothed.states):
        sd = np.sqrt(np.diag(ways[k] @ joint @ ways[k].T))
        np.testing.assert_allclose(np.sqrt(np.diag(state.covariance)), sd, rtol=0.01)
    for k, (first, second) in enumerate(pairwise(ways)):
        sd = np.sqrt(np.diag((second - first) @ joint @ (second - first).T))
        # Of a constant parameter rounding leaves a millionth of its prior.
        one, other = (state.covariance for state in smoothed.states[k : k + 2])
        told = np.diag(one + other - 2.0 * smoothed.gains[k] @ other)
        np.testing.assert_allclose(told, sd**2, rtol=0.02, atol=1e-10)


def test_smoothing_knows_more_than_the_updates(followed):
    smoothed = smooth(followed.drift, followed.outcomes)
    assert smoothed.converged
    known = [np.linalg.slogdet(state.covariance)[1] for state in smoothed.states]
    filtered = [np.linalg.slogdet(outcome.state.covariance)[1] for outcome in followed.outcomes]
    assert all(a < b for a, b in zip(known[:-1], filtered[:-1], strict=True))
