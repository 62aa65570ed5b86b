"""Where a linear filter starts from a curved posterior."""

import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, campaign

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.draws import independent_draws
from fpcal_bayes.infer.tasks.error import task_rows
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.tracking.start import linear_start
from fpcal_bayes.tracking.tracker import calibrate

MODEL = CavityModel.of(CELL)
SWEEPS = campaign(4, sessions=0)[1]
FOUND = identify(CELL, SWEEPS)
DRAWS = independent_draws(FOUND, 1000, 3)


def test_draws_close_by_keep_their_moments():
    # So near that the model is linear between them.
    away = 1e-6 * (DRAWS - FOUND.estimate.values) / CELL.free.prior_sd
    start = linear_start(FOUND.estimate, FOUND.estimate.values + away * CELL.free.prior_sd, SWEEPS)
    found = start.covariance / np.outer(CELL.free.prior_sd, CELL.free.prior_sd)
    np.testing.assert_allclose(1e12 * found, 1e12 * away.T @ away / len(away), atol=4e-3)


@pytest.mark.parametrize("name", ["circle", "tilt-x", "tilt-z", "spin"])
def test_linear_predictions_spread_as_the_draws_do(name):
    start = linear_start(FOUND.estimate, DRAWS, SWEEPS)
    task = task_path(CELL, FOUND.estimate.vector(), name, n_points=9).driven()
    rows = task_rows(MODEL, task)
    true = MODEL.predict(DRAWS, rows)
    predicted, jacobian = MODEL.predict_with_jacobian(start.values, rows)
    worst = int(np.argmax(true.std(axis=0)))
    sd = np.sqrt(np.diag(jacobian @ start.covariance @ jacobian.T))[worst]
    # Of a spin the curvature leaves more than any linear state can hold.
    assert sd == pytest.approx(true[:, worst].std(), rel=0.3 if name == "spin" else 0.05)
    assert abs(predicted[worst] - true[:, worst].mean()) < 0.3 * sd


def test_the_track_starts_there():
    state = calibrate(CELL, DRIFT, SWEEPS)[0].state
    expected = linear_start(FOUND.estimate, independent_draws(FOUND, 2000), SWEEPS)
    np.testing.assert_allclose(DRIFT.values(state.mean), FOUND.estimate.values, rtol=1e-9)
    np.testing.assert_allclose(DRIFT.covariance(state.covariance), expected.covariance, rtol=1e-6, atol=1e-15)
