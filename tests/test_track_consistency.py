"""Verdicts on simulated campaigns; the rates over hundreds of weeks are in studies/tracking.py."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from track_fixtures import CELL, DRIFT, campaign, knock, step_of_beta_4

from fpcal_bayes.analysis.history import session_bounds
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.alarms import Limits, Monitor, extend, findings
from fpcal_bayes.tracking.drift import State
from fpcal_bayes.tracking.filter import Innovation, update
from fpcal_bayes.tracking.measurement import LinearMeasurement
from fpcal_bayes.tracking.tracker import track


def verdicts(seed: int, **settings) -> list[str]:
    return [outcome.verdict for outcome in track(CELL, campaign(seed, **settings)[1]).outcomes]


@pytest.mark.parametrize("seed", range(3))
def test_a_quiet_campaign_is_as_modelled(seed):
    found = track(CELL, campaign(seed, sessions=12)[1])
    assert {outcome.verdict for outcome in found.outcomes} == {"as-modelled"}
    assert found.calibration_due is None
    assert not any(outcome.jump.any() for outcome in found.outcomes)


@pytest.mark.parametrize("seed", range(4))
def test_a_knock_is_seen_at_the_next_session_and_the_filter_converges_again(seed):
    change = knock(np.random.default_rng(seed))
    truth, sweeps = campaign(seed, sessions=8, change=change, changed=4)
    found = track(CELL, sweeps)
    said = [outcome.verdict for outcome in found.outcomes]
    assert said == ["as-modelled"] * 4 + ["extrinsics-moved"] + ["as-modelled"] * 4
    assert found.outcomes[4].evidence
    later = found.outcomes[5:]
    squared, dof = sum(outcome.nis for outcome in later), sum(outcome.dof for outcome in later)
    assert 0.001 < stats.chi2.cdf(squared, dof) < 0.999
    # x_wf has followed the jump of 20 um.
    at = DRIFT.parameters.position("x_wf")
    estimate = found.estimate()
    assert abs(estimate.values[at] - truth.values[-1][at]) < 5 * estimate.sd[at]
    assert estimate.sd[at] < 2.0


def test_a_step_of_the_robot_is_told_from_a_knock():
    # Every four hours: the step stands out of the walk of beta_4 by seven standard deviations.
    for seed in range(4):
        truth, sweeps = campaign(seed, sessions=9, hours=4.0, change=step_of_beta_4(), changed=5)
        found = track(CELL, sweeps)
        said = [outcome.verdict for outcome in found.outcomes]
        assert "intrinsics-moved" not in said[:5]
        assert "intrinsics-moved" in said[5:8]
        assert found.calibration_due == f"s{said.index('intrinsics-moved')}"
        assert any("beta_4" in text or "chi-square" in text for o in found.outcomes for text in o.evidence)
        assert truth is not None


def test_two_translations_cannot_see_the_robot():
    """At one orientation, the extrinsic parameters explain all that a step of beta_4 does to two translations."""
    truth, sweeps = campaign(0, sessions=5, hours=4.0, count=2, change=step_of_beta_4(), changed=2)
    along = np.array([[150.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]])
    few = np.flatnonzero(sweeps.session != "day0")
    q_start, q_end = sweeps.q_start.copy(), sweeps.q_end.copy()
    q_start[few], q_end[few] = np.tile(-along, (5, 1)), np.tile(along, (5, 1))
    measured = simulate_um(CELL, truth, replace(sweeps, q_start=q_start, q_end=q_end), sigma=0.005, seed=0)
    found = track(CELL, measured)
    said = [outcome.verdict for outcome in found.outcomes]
    assert "extrinsics-moved" in said
    assert "intrinsics-moved" not in said


def linear_world(rows: int, seed: int):
    random = np.random.default_rng(seed)
    n = DRIFT.n_states
    root = random.standard_normal((n, n)) / 400.0
    state = State(0.0, np.zeros(n), root @ root.T + 1e-6 * np.eye(n))
    return state, random.standard_normal((rows, n)) * 300.0, random


def test_scores_are_standard_normal_and_find_the_jump():
    """Linear rows: under no change the tests fail as rarely as stated, a jump is found with its size."""
    limits, alarms, count = Limits(full_per_week=8.4, extrinsic_per_week=8.4), 0, 300
    state, h, random = linear_world(12, 0)
    root = np.linalg.cholesky(state.covariance)
    for _ in range(count):
        x = root @ random.standard_normal(DRIFT.n_states)
        taken = update(state, LinearMeasurement(h @ x + random.standard_normal(12), h))
        innovation = Innovation.of(taken.misfit, taken.jacobian, state.covariance, 0.0)
        monitor = extend(Monitor(), "s", 1.0, innovation, taken.gain, np.eye(21), limits, DRIFT)
        alarms += bool(findings(monitor, limits, DRIFT))
    # 0.05 for each kind of alarm; the tests of one session overlap, and the innovation alone has a third of 0.05.
    assert 0.008 * count < alarms < 0.1 * count + 4 * np.sqrt(0.1 * count)
    at = DRIFT.parameters.position("alpha_2")
    jump = np.zeros(21)
    jump[at] = 4 * limits.jump(DRIFT)[at]
    taken = update(state, LinearMeasurement(h @ jump, h))
    innovation = Innovation.of(taken.misfit, taken.jacobian, state.covariance, 0.0)
    monitor = extend(Monitor(), "s", 1.0, innovation, taken.gain, np.eye(21), limits, DRIFT)
    first = findings(monitor, limits, DRIFT)[0]
    assert first.verdict == "intrinsics-moved"
    assert first.evidence.startswith("alpha_2 moved by +0.")


def test_the_response_of_the_filter_is_that_of_a_filter_that_jumped():
    """What a jump leaves in later innovations: regression against simply filtering shifted data."""
    state, h, random = linear_world(5, 1)
    limits = Limits()
    jump = limits.jump(DRIFT) * random.standard_normal(21)
    more = random.standard_normal((5, 21)) * 300.0
    both = []
    for shift in (np.zeros(21), jump):
        now, monitor, innovations = state, Monitor(), []
        for rows in (h, more):
            taken = update(now, LinearMeasurement(rows @ shift, rows))
            innovation = Innovation.of(taken.misfit, taken.jacobian, now.covariance, 0.0)
            monitor = extend(monitor, "s", 8.0, innovation, taken.gain, np.eye(21), limits, DRIFT)
            now = taken.state
            innovations.append(innovation.whitened)
        both.append((now, monitor, innovations))
    onset = both[1][1].onsets[0]
    # Without noise the score is the information times the jump.
    units = jump / limits.jump(DRIFT)
    np.testing.assert_allclose(onset.score, onset.information @ units, rtol=1e-8)
    np.testing.assert_allclose(onset.response @ units, jump - (both[1][0].mean - both[0][0].mean), atol=1e-8)


def test_bounds_are_those_of_chi_square():
    outcome = SimpleNamespace(dof=7)
    np.testing.assert_allclose(session_bounds(outcome), stats.chi2.ppf([0.025, 0.975], 7))


def test_frequent_sessions_raise_no_more_false_alarms():
    limits = Limits()
    state, h, _ = linear_world(3, 2)
    taken = update(state, LinearMeasurement(np.full(3, 6000.0), h))
    innovation = Innovation.of(taken.misfit, taken.jacobian, state.covariance, 0.0)
    allowed = []
    for hours in (1.0, 8.0):
        monitor = extend(Monitor(), "s", hours, innovation, taken.gain, np.eye(21), limits, DRIFT)
        allowed.append({f.evidence[:20]: f.limit for f in findings(monitor, limits, DRIFT)})
    shared = allowed[0].keys() & allowed[1].keys()
    assert shared
    assert all(allowed[1][key] == pytest.approx(8 * allowed[0][key]) for key in shared)
