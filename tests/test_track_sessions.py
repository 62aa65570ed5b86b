"""Histories that cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import CELL, campaign

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.tracking.sessions import check_sessions, hours_of, session_sha256
from fpcal_bayes.tracking.tracker import track

SWEEPS = campaign(0, sessions=3)[1]


def test_sessions_come_in_order_of_time_wherever_they_stand():
    shuffled = SWEEPS.take(np.argsort(SWEEPS.session == "s1", kind="stable"))
    assert [str(part.session[0]) for part in check_sessions(shuffled)] == ["day0", "s1", "s2", "s3"]


def test_overlapping_sessions_are_refused():
    hours = SWEEPS.time_h.copy()
    hours[np.flatnonzero(SWEEPS.session == "s1")[-1]] = 17.0
    with pytest.raises(InputError, match=r"row 77, column time_h: session s2 begins at 16 h before session s1 ends"):
        check_sessions(replace(SWEEPS, time_h=hours))


def test_repeated_sessions_and_rows_are_refused():
    again = SWEEPS.take(SWEEPS.session == "s3")
    copy = replace(again, session=np.full(6, "s4"))
    with pytest.raises(InputError, match="session s4 repeats session s3"):
        check_sessions(join([SWEEPS, copy]))
    with pytest.raises(InputError, match="row 83: session s3 holds the row of line 77 twice"):
        check_sessions(join([SWEEPS.take(SWEEPS.session != "s2"), again]))


def test_the_future_is_refused():
    with pytest.raises(InputError, match="session s3 lies in the future: 24 h, now is 20 h"):
        check_sessions(SWEEPS, 20.0)
    late = replace(SWEEPS, utc=np.where(SWEEPS.session == "s3", "2999-01-01T00:00:00Z", ""))
    with pytest.raises(InputError, match="column utc: session s3 lies in the future by this machine's clock"):
        check_sessions(late)
    assert len(check_sessions(late, 30.0)) == 4


def test_clocks_must_run_as_hours_do():
    utc = np.select([SWEEPS.session == "s1", SWEEPS.session == "s2"], ["2024-05-02T00:00Z", "2024-05-01T00:00Z"], "")
    with pytest.raises(InputError, match="from session s1 to s2 utc counts -24 h and time_h 8 h"):
        check_sessions(replace(SWEEPS, utc=utc))


def test_times_of_a_user():
    timed = replace(SWEEPS, utc=np.where(SWEEPS.session == "s1", "2024-05-01T08:00:00Z", ""))
    assert hours_of("12.5", timed) == 12.5
    assert hours_of("2024-05-01T10:30:00+01:00", timed) == pytest.approx(9.5)
    with pytest.raises(InputError, match="no row carries utc"):
        hours_of("2024-05-01T10:30:00", SWEEPS)
    with pytest.raises(InputError, match="expected hours since the campaign began, or ISO 8601"):
        hours_of("soon", timed)


def test_a_campaign_without_calibration_is_refused():
    with pytest.raises(InputError, match=r"session 's1' is no calibration: its 6 rows determine \d of 21"):
        track(CELL, SWEEPS.take(SWEEPS.session != "day0"))


def test_a_plan_is_refused():
    with pytest.raises(InputError, match="expected measured sweeps"):
        check_sessions(SWEEPS.with_measurement(np.full(len(SWEEPS), np.nan), np.nan))


def test_the_hash_of_a_session_is_that_of_its_numbers():
    part = SWEEPS.of_session("s1")
    assert session_sha256(part) == session_sha256(replace(part, label=np.full(6, "x")))
    assert session_sha256(part) != session_sha256(replace(part, dl=part.dl + 1e-9))


BEGIN = np.datetime64("2024-10-24T04:00:00")


def clocks(hours: np.ndarray, zone: str = "Z") -> np.ndarray:
    return np.array([f"{BEGIN + np.timedelta64(round(3600 * hour), 's')}{zone}" for hour in hours.tolist()])


@pytest.mark.parametrize(
    ("time_h", "utc", "expected"),
    [
        # In the night to 27 October clocks went back: time_h kept to them, utc did not.
        (lambda h: h - (h > 10), clocks, "utc counts 16 h and time_h 15 h, expected the same [(]summer time"),
        (lambda h: 60.0 * h, clocks, "time_h looks like minutes"),
        (lambda h: h / 24.0, clocks, "time_h looks like days"),
        (lambda h: h, lambda h: np.where(h > 10, clocks(h + 2.0, ""), clocks(h)), "column utc: from session .* 18 h"),
        (lambda h: h, lambda h: clocks(h + 0.7 * (h > 20)), "row 88, column utc: .* 24.7 h and time_h 24 h"),
    ],
)
def test_clocks_and_hours_differ_by_one_constant(time_h, utc, expected):
    hours = SWEEPS.time_h
    with pytest.raises(InputError, match=expected):
        check_sessions(replace(SWEEPS, time_h=time_h(hours), utc=utc(hours)))


def test_a_constant_difference_is_no_contradiction():
    # The campaign began before the first session; rows of a session stand at one time_h, their clocks run on.
    later = np.arange(len(SWEEPS)) % 6 / 60.0
    for utc in (clocks(SWEEPS.time_h + 5.0), clocks(SWEEPS.time_h + later), clocks(SWEEPS.time_h, "+02:00")):
        assert len(check_sessions(replace(SWEEPS, utc=utc))) == 4


def test_a_session_sent_again_later_is_no_new_measurement():
    copy = replace(SWEEPS.take(SWEEPS.session == "s1"), session=np.full(6, "s9"), time_h=np.full(6, 40.0))
    with pytest.raises(InputError, match="session s9 repeats session s1 to the last digit"):
        check_sessions(join([SWEEPS, copy]))
    # Counts of whole fringes do repeat.
    coarse = replace(SWEEPS, sigma=np.full(len(SWEEPS), 0.3))
    assert check_sessions(join([coarse, replace(copy, sigma=np.full(6, 0.3))]))


def test_sessions_that_differ_by_case_or_blanks(tmp_path):
    names = np.where(SWEEPS.session == "s2", "S1 ", SWEEPS.session)
    with pytest.raises(InputError, match="sessions 's1' and 'S1 ' differ by case or blanks only"):
        write_csv(tmp_path / "a.csv", replace(SWEEPS, session=names), CELL)
