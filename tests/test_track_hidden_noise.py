"""Noise of the drift that an uncertain geometry adds."""

from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, campaign, plan

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.drift import State
from fpcal_bayes.tracking.start import with_hidden_noise

MODEL = CavityModel.of(CELL)
FOUND = identify(CELL, campaign(4, sessions=0)[1]).estimate
STATE = State(0.0, *DRIFT.initial(FOUND.values, FOUND.covariance))
DAY = with_hidden_noise(DRIFT, MODEL, STATE).transition(24.0).noise


def test_the_change_of_other_sweeps_spreads_as_drift_through_drawn_geometries_does():
    random = np.random.default_rng(8)
    asked = plan(60, random)
    rows = MODEL.rows(asked.q_start, asked.q_end)
    _, known = MODEL.predict_with_jacobian(FOUND.values, rows)
    excess = np.zeros((60, 60))
    # What a drawn geometry makes of each parameter's walk beyond what the known one does; the walks are independent.
    factor = np.linalg.cholesky(STATE.covariance + 1e-18 * np.eye(DRIFT.n_states))
    draws = 300
    for _ in range(draws):
        half = factor @ random.standard_normal(DRIFT.n_states)
        ahead, back = (
            MODEL.predict_with_jacobian(DRIFT.values(STATE.mean + sign * half), rows)[1] for sign in (1.0, -1.0)
        )
        beyond = (ahead - back) / 2.0 * DRIFT.scale * DRIFT.walk
        excess += beyond @ beyond.T / draws
    scaled = known * DRIFT.scale
    predicted = scaled @ (DAY - DRIFT.transition(24.0).noise) @ scaled.T
    ratio = np.trace(predicted) / np.trace(excess)
    # A few directions of what drift does through other geometries lie outside of the known one's.
    assert ratio == pytest.approx(1.0, abs=0.15)


def test_a_known_geometry_hides_nothing():
    exact = replace(STATE, covariance=1e-8 * STATE.covariance)
    assert np.abs(with_hidden_noise(DRIFT, MODEL, exact).transition(24.0).noise - np.diag(DRIFT.walk**2)).max() < 1e-12


def test_it_is_small_beside_the_walk_and_grows_with_its_square():
    hidden = DAY - DRIFT.transition(24.0).noise
    assert np.linalg.eigvalsh(hidden).min() > -1e-15
    assert 0.0 < np.trace(hidden) < 0.1 * np.trace(np.diag(DRIFT.walk**2))
    double = DRIFT.resized(lambda size: replace(size, walk=2.0 * size.walk))
    four = with_hidden_noise(double, MODEL, STATE).transition(24.0).noise
    np.testing.assert_allclose(four, 4.0 * DAY, rtol=1e-9, atol=1e-16)
