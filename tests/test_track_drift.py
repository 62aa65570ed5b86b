"""Process models against simulation and against each other."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from track_fixtures import CELL, DRIFT

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model.cell.tables import DriftSize
from fpcal_bayes.tracking.drift import DriftModel

DEG = np.pi / 180.0


def model_of(**sizes: float) -> DriftModel:
    """Drift of x_wf alone."""
    parameters = CELL.parameters[CELL.parameters.position("x_wf") : CELL.parameters.position("x_wf") + 1]
    return DriftModel(parameters, (DriftSize("x_wf", **sizes),))


EVERYTHING = {"walk": 0.5, "rate_sd": 0.3, "bounded_sd": 0.8, "bounded_hours": 6.0, "temperature": 0.2}


def test_the_built_in_cell_states_the_sizes_of_the_papers_tables():
    shown = {size.name: size.walk / CELL.parameters[size.name].scale for size in CELL.drift}
    expected = {"beta_et": 0.010, "theta_et": 0.020, "beta_wf": 0.010, "theta_wf": 0.016, "z_et": 0.22, "x_wf": 0.51}
    expected |= {"y_wf": 0.76, "z_wf": 1.1, "beta_4": 0.034, "alpha_5": 0.016, "theta_6": 0.014, "alpha_4": 0.009}
    assert shown == pytest.approx(expected)


def test_a_cell_without_drift_is_refused():
    with pytest.raises(InputError, match="states no drift: expected it in its file"):
        DriftModel.of(replace(CELL, drift=()))


def test_drift_sizes_leave_the_hash_of_the_cell_alone():
    other = replace(CELL, drift=())
    assert other.sha256 == CELL.sha256


@given(st.floats(0.1, 30.0), st.floats(0.1, 30.0), st.floats(-5.0, 5.0))
def test_two_steps_are_one(first: float, second: float, kelvin: float):
    drift = model_of(**EVERYTHING, temperature_sd=0.1)
    a, b = drift.transition(first, kelvin), drift.transition(second, -0.3 * kelvin)
    whole = drift.transition(first + second, 0.7 * kelvin)
    np.testing.assert_allclose(b.matrix @ a.matrix, whole.matrix, atol=1e-12)
    np.testing.assert_allclose(b.matrix @ a.noise @ b.matrix.T + b.noise, whole.noise, atol=1e-12)
    np.testing.assert_allclose(b.matrix @ a.shift + b.shift, whole.shift, atol=1e-12)


def test_a_returning_motion_stays_bounded_and_forgets():
    drift = model_of(bounded_sd=0.8, bounded_hours=6.0)
    mean, covariance = drift.initial(np.array([0.0]), np.zeros((1, 1)))
    step = drift.transition(1000.0)
    spread = step.matrix @ covariance @ step.matrix.T + step.noise
    # The state was known at the start: its constant part is as uncertain as the motion then, and the motion now adds.
    assert drift.covariance(spread)[0, 0] == pytest.approx(2 * 0.8**2)
    assert spread[1, 1] == pytest.approx(1.0)
    assert mean.tolist() == [0.0, 0.0]


def test_a_returning_motion_matches_euler_steps():
    drift = model_of(bounded_sd=0.8, bounded_hours=6.0)
    random, count, fine = np.random.default_rng(0), 20_000, 200
    motion = 0.8 * random.standard_normal(count)
    start = motion.copy()
    for _ in range(fine):
        step = 3.0 / fine
        motion += -motion / 6.0 * step + 0.8 * np.sqrt(2 * step / 6.0) * random.standard_normal(count)
    step = drift.transition(3.0)
    _, covariance = drift.initial(np.array([0.0]), np.zeros((1, 1)))
    spread = drift.covariance(step.matrix @ covariance @ step.matrix.T + step.noise)
    assert np.var(motion - start) == pytest.approx(spread[0, 0], rel=4 * np.sqrt(2 / count) + 0.01)


def test_a_rate_and_a_known_temperature_move_the_mean():
    drift = model_of(rate_sd=2.0, temperature=0.5)
    mean, _ = drift.initial(np.array([1.0]), np.zeros((1, 1)))
    mean[1] = 1.5  # the rate is 1.5 of its standard deviations: 3 um a day
    step = drift.transition(12.0, 4.0)
    assert drift.values(step.matrix @ mean + step.shift)[0] == pytest.approx(1.0 + 1.5 + 2.0)


def test_the_whole_cell_walks_by_its_sizes():
    step = DRIFT.transition(96.0)
    np.testing.assert_array_equal(step.matrix, np.eye(21))
    sd = np.sqrt(np.diag(DRIFT.covariance(step.noise)))
    assert sd[DRIFT.parameters.position("beta_4")] == pytest.approx(2 * 0.034 * DEG)
