"""Sessions that are looked at again together, now and then."""

import numpy as np
from track_fixtures import CELL, DRIFT, campaign, knock

from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking import smoother
from fpcal_bayes.tracking import smoother as following
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.record import record_of, resume
from fpcal_bayes.tracking.session import take_in
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.smoother import smooth
from fpcal_bayes.tracking.tracker import track

LIMITS = Limits()
MODEL = CavityModel.of(CELL)
SWEEPS = campaign(7, sessions=9, change=knock(np.random.default_rng(1)), changed=5)[1]
QUIET = campaign(8, sessions=9)[1]


def looks(found, sweeps) -> list[int]:
    """Numbers of the sessions whose state is not that of their own update."""
    parts = [sweeps.of_session(outcome.session) for outcome in found.outcomes]
    numbers = []
    for i in range(1, len(parts)):
        before = found.outcomes[i - 1]
        alone = take_in(found.drift, MODEL, LIMITS, before.state, before.monitor, parts[i])
        if not np.array_equal(alone.state.mean, found.outcomes[i].state.mean):
            numbers.append(i)
    return numbers


def test_looks_come_at_doubling_intervals_and_after_a_jump():
    assert looks(track(CELL, QUIET), QUIET) == [2, 4, 8]
    found = track(CELL, SWEEPS)
    assert found.outcomes[5].verdict == "extrinsics-moved"
    assert looks(found, SWEEPS) == [2, 4, 6, 7, 8, 9]


def test_the_state_is_then_the_last_of_the_smoother():
    found = track(CELL, QUIET)
    expected = smooth(found.drift, found.outcomes[:9]).states[-1]
    away = (found.outcomes[8].state.mean - expected.mean) / np.sqrt(np.diag(expected.covariance))
    assert np.abs(away).max() < 0.03


def test_only_the_last_sessions_are_looked_at(monkeypatch):
    whole = track(CELL, SWEEPS)
    monkeypatch.setattr(following, "_MOST_SESSIONS", 4)
    found = track(CELL, SWEEPS)
    assert not np.array_equal(found.last.state.mean, whole.last.state.mean)
    away = (found.last.state.mean - whole.last.state.mean) / np.sqrt(np.diag(whole.last.state.covariance))
    assert np.abs(away).max() < 1.0
    part = SWEEPS.take(~np.isin(SWEEPS.session, ["s7", "s8", "s9"]))
    saved = record_of(track(CELL, part), Campaign.of(part, CELL).sweeps, LIMITS)
    known, _ = resume(saved, CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file")
    np.testing.assert_array_equal(track(CELL, SWEEPS, known=known).last.state.mean, found.last.state.mean)


def test_a_look_that_does_not_converge_changes_nothing(monkeypatch):
    monkeypatch.setattr(smoother, "_STEP_TOLERANCE", 0.0)
    monkeypatch.setattr(smoother, "_MOST_STEPS", 1)
    found = track(CELL, QUIET)
    assert not smooth(found.drift, found.outcomes).converged
    assert looks(found, QUIET) == []
