"""A policy in charge of a simulated cell, and how its tasks are judged."""

from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, PROTOCOL, SIGMA, campaign

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.decision.closed_loop import STEP_H, run_policy, task_peaks
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.decision.policy import Policy
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.tracker import calibrate, track

MODEL = CavityModel.of(CELL)
TRUTH, SWEEPS = campaign(3, sessions=8, hours=1.0)
START = calibrate(CELL, DRIFT, SWEEPS.of_session("day0"))[0]


def measure(plan, time_h):
    n = len(plan)
    timed = replace(plan, session=np.full(n, f"h{time_h:.2f}"), time_h=np.full(n, time_h))
    return simulate_um(CELL, TRUTH, timed, sigma=SIGMA, seed=round(100 * time_h))


def run(costs):
    return run_policy(Policy.of(DRIFT, MODEL, Goal(50.0), costs, PROTOCOL), START, measure, 6.0)


def test_sessions_come_when_they_were_planned():
    loop = run(Costs(most_sweeps=2, sigma_nm=1e3 * SIGMA))
    times = np.array([outcome.time_h for outcome in loop.outcomes])
    assert len(loop.decisions) == len(loop.sweeps) == len(times) - 1
    assert (np.diff(times) > 0.0).all()
    np.testing.assert_allclose(times, STEP_H * np.round(times / STEP_H), rtol=0, atol=1e-9)
    assert 3 <= len(loop.sweeps) <= 12
    assert times[-1] <= 6.0
    for decision, sweeps, outcome in zip(loop.decisions, loop.sweeps, loop.outcomes[1:], strict=True):
        assert decision.action == "extrinsic"
        np.testing.assert_array_equal(sweeps.q_end, decision.sweeps.q_end)
        assert outcome.time_h == pytest.approx(decision.now_h)
        # Planned for the last step at which the tolerance is expected to hold.
        assert decision.now.exceeds(0.05) <= 0.1 < decision.at_horizon.exceeds(0.05)
    peaks = task_peaks(MODEL, TRUTH, held(loop), ("circle",), np.arange(0.0, 6.0, 0.1))
    assert (peaks <= 0.05).mean() > 0.9


def test_the_filter_is_that_of_a_track_of_the_same_sessions():
    loop = run(Costs(most_sweeps=2, sigma_nm=1e3 * SIGMA))
    found = track(CELL, join([SWEEPS.of_session("day0"), *loop.sweeps], file="campaign"))
    for one, other in zip(loop.outcomes, found.outcomes, strict=True):
        np.testing.assert_array_equal(one.state.mean, other.state.mean)
        np.testing.assert_array_equal(one.state.covariance, other.state.covariance)


def held(loop):
    return [(outcome.time_h, DRIFT.values(outcome.state.mean)) for outcome in loop.outcomes]


def test_the_robot_is_looked_at_when_due():
    loop = run(Costs(most_sweeps=2, sigma_nm=1e3 * SIGMA, diagnosis_h=4.0))
    looks = [d.now_h for d in loop.decisions if "could show a change of the robot" in d.reason]
    assert looks == [pytest.approx(4.0, abs=0.06)]


def test_at_least_as_many_sweeps_as_asked_for():
    loop = run(Costs(least_sweeps=2, most_sweeps=2, sigma_nm=1e3 * SIGMA))
    assert {len(sweeps) for sweeps in loop.sweeps} == {2}
    with pytest.raises(InputError, match="at least 3 sweeps, expected no more than 2"):
        Costs(least_sweeps=3, most_sweeps=2)


def test_peaks_are_those_of_the_estimate_held_at_the_time():
    values = [START.state.mean, START.state.mean + 0.01]
    steps = [(0.0, DRIFT.values(values[0])), (3.0, DRIFT.values(values[1]))]
    times = np.array([0.0, 2.9, 3.0, 5.0])
    found = task_peaks(MODEL, TRUTH, steps, ("circle", "tilt-x"), times)
    for column, (time_h, which) in enumerate(zip(times, (0, 0, 1, 1), strict=True)):
        estimate = DRIFT.values(values[which])
        for row, name in enumerate(("circle", "tilt-x")):
            task = task_path(CELL, MODEL.vector(estimate), name).driven()
            expected = peak_to_peak(task_errors(MODEL, TRUTH.at(time_h), estimate, task))[0]
            assert found[row, column] == pytest.approx(expected, rel=1e-9)
