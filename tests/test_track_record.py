"""A track saved and taken up again."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, campaign, knock

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.tracking import record
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.record import record_of, resume
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.smoother import smooth
from fpcal_bayes.tracking.tracker import smooth_track, track

LIMITS = Limits()
SWEEPS = campaign(5, sessions=7, change=knock(np.random.default_rng(0)), changed=3)[1]


def early(*sessions: str):
    return SWEEPS.take(np.isin(SWEEPS.session, ["day0", *sessions]))


def assert_same(a, b):
    assert [o.session for o in a.outcomes] == [o.session for o in b.outcomes]
    for one, other in zip(a.outcomes, b.outcomes, strict=True):
        np.testing.assert_array_equal(one.state.mean, other.state.mean)
        np.testing.assert_array_equal(one.state.covariance, other.state.covariance)
        np.testing.assert_array_equal(one.predicted.covariance, other.predicted.covariance)
        assert (one.verdict, one.nis, one.evidence) == (other.verdict, other.nis, other.evidence)


@pytest.fixture(scope="module")
def whole():
    return track(CELL, SWEEPS)


@pytest.fixture
def saved(tmp_path):
    """A campaign file tracked up to session s4, two sessions after a knock."""
    part = early("s1", "s2", "s3", "s4")
    path = tmp_path / "campaign.h5"
    made = record_of(track(CELL, part), part, LIMITS)
    write_campaign(path, replace(Campaign.of(part, CELL), track=made), CELL)
    # What this process remembers of it is another test's matter.
    record._last.clear()
    return read_campaign(path, CELL).track


def test_tracking_goes_on_as_if_it_had_never_stopped(saved, whole):
    known, note = resume(saved, CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file")
    assert note == ""
    assert known.resumed == 5
    assert_same(track(CELL, SWEEPS, known=known), whole)


def test_what_is_remembered_of_a_track_is_what_its_file_says(saved):
    parts = check_sessions(SWEEPS)
    read, note = resume(saved, CELL, DRIFT, LIMITS, parts, "file")
    record._last.clear()
    part = early("s1", "s2", "s3", "s4")
    record_of(track(CELL, part), part, LIMITS)
    remembered, again = resume(saved, CELL, DRIFT, LIMITS, parts, "file")
    assert (note, again) == ("", "")
    assert read.outcomes[2].measurement is None
    assert remembered.outcomes[2].measurement is not None
    assert_same(read, remembered)
    assert_same(track(CELL, SWEEPS, known=read), track(CELL, SWEEPS, known=remembered))


def test_a_late_session_is_taken_in_at_its_time(whole):
    without = SWEEPS.take(SWEEPS.session != "s5")
    record = record_of(track(CELL, without), without, LIMITS)
    known, note = resume(record, CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file")
    assert note == "sessions after s4 are taken in anew"
    assert len(known.outcomes) == 5
    assert_same(track(CELL, SWEEPS, known=known), whole)


def test_a_changed_session_is_taken_in_anew(saved, whole):
    changed = SWEEPS.with_measurement(np.where(SWEEPS.session == "s2", SWEEPS.dl + 1e-4, SWEEPS.dl), SWEEPS.sigma)
    known, note = resume(saved, CELL, DRIFT, LIMITS, check_sessions(changed), "file")
    assert note == "sessions after s1 are taken in anew"
    assert_same(track(CELL, changed, known=known), track(CELL, changed))


def test_other_drift_sizes_or_limits_start_anew(saved):
    other = DRIFT.resized(lambda size: replace(size, walk=2 * size.walk))
    for drift, limits in ((other, LIMITS), (DRIFT, Limits(looks=2))):
        known, note = resume(saved, CELL, drift, limits, check_sessions(SWEEPS), "file")
        assert known is None
        assert "all sessions are taken in anew" in note


def test_a_state_of_another_cell_is_refused(saved):
    other = CELL.with_opd("perpendicular")
    with pytest.raises(InputError, match="file: the track saved in it is of another cell or path model"):
        resume(saved, other, DRIFT, LIMITS, check_sessions(SWEEPS), "file")


@pytest.mark.parametrize("summary", ["[]", "{}", "not JSON", '{"sessions": [1], "status": [], "solutions": 1}'])
def test_a_damaged_state_is_refused(saved, summary):
    with pytest.raises(InputError, match="file: the saved track cannot be read"):
        resume(replace(saved, summary=summary), CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file")


def test_a_resumed_track_is_smoothed_like_a_whole_one(saved, whole):
    known, _ = resume(saved, CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file")
    with pytest.raises(ValueError, match="session 's1' comes without its measurement"):
        smooth(known.drift, known.outcomes)
    resumed = track(CELL, SWEEPS, known=known)
    found, expected = smooth_track(resumed, SWEEPS), smooth(whole.drift, whole.outcomes)
    for one, other in zip(found.states, expected.states, strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_track_of_an_older_version_is_taken_in_anew(saved):
    summary = json.loads(saved.summary)
    del summary["solutions"]
    known, note = resume(
        replace(saved, summary=json.dumps(summary)), CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file"
    )
    assert known is None
    assert note == "the track was saved by an older version: all sessions are taken in anew"


def test_a_track_whose_covariances_are_whole_is_read(saved, tmp_path):
    path = tmp_path / "campaign.h5"
    with h5py.File(path, "r+") as file:
        group = file["track"]
        assert group["covariance"].ndim == 2
        del group["covariance"]
        group["covariance"] = saved.covariance
    read = read_campaign(path, CELL).track
    np.testing.assert_array_equal(read.covariance, saved.covariance)


def test_a_covariance_that_is_not_symmetric_to_the_last_bit_is_kept(saved, tmp_path):
    covariance = saved.covariance.copy()
    covariance[0, 3, 1] = np.nextafter(covariance[0, 1, 3], 1.0)
    path, part = tmp_path / "campaign.h5", early("s1", "s2", "s3", "s4")
    write_campaign(path, replace(Campaign.of(part, CELL), track=replace(saved, covariance=covariance)), CELL)
    np.testing.assert_array_equal(read_campaign(path, CELL).track.covariance, covariance)


def test_a_state_that_does_not_say_how_it_began_is_refused(saved):
    summary = json.loads(saved.summary)
    del summary["from_prior"]
    with pytest.raises(InputError, match="file: the saved track cannot be read"):
        resume(replace(saved, summary=json.dumps(summary)), CELL, DRIFT, LIMITS, check_sessions(SWEEPS), "file")
