"""The command ``fpcal decide``, and how long the estimate of ``fpcal track`` holds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from track_fixtures import CELL, campaign, step_of_beta_4

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import read_sweeps, write_sweeps

_, SWEEPS = campaign(3, sessions=1)
UTC = [f"2024-05-01T{6 + int(hour):02d}:30:00Z" for hour in SWEEPS.time_h]


@pytest.fixture(autouse=True)
def week(tmp_path, monkeypatch) -> str:
    monkeypatch.chdir(tmp_path)
    write_sweeps("week.csv", SWEEPS, CELL)
    return "week.csv"


def decided(*arguments: str) -> dict:
    assert main(["decide", *arguments, "--json", "out.json"]) == 0
    return json.loads(Path("out.json").read_text())


def refused(capsys, *arguments: str) -> str:
    assert main(["decide", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


def test_hold(week, capsys):
    content = decided(week, "--tolerance-nm", "50")
    assert (content["schema"], content["command"]) == ("fpcal/1", "decide")
    assert {"parameters", "covariance", "warnings"} <= set(content)
    decision = content["decision"]
    assert (decision["action"], decision["sweeps"], decision["now_h"]) == ("hold", [], 8.0)
    assert 0.5 < decision["hold_hours"] < 2.0
    error = decision["task_error_nm"]
    assert set(error) == {"now", "at_horizon", "after"}
    assert error["now"] < error["after"] < 50 < error["at_horizon"]
    assert f"hold until {8.0 + decision['hold_hours']:.2f} h" in capsys.readouterr().out


def test_sweeps_are_ready_to_run(week, capsys):
    before = file_sha256(Path(week))
    decision = decided(week, "--now", "11", "-o", "next.csv")["decision"]
    assert file_sha256(Path(week)) == before
    assert (decision["action"], decision["hold_hours"]) == ("extrinsic", 0.0)
    assert decision["task_error_nm"]["after"] < decision["task_error_nm"]["now"]
    plan = read_sweeps("next.csv", CELL, plan=True)
    assert len(plan) == len(decision["sweeps"]) == decision["minutes"] / 2
    assert plan.q_end[0, 0] == pytest.approx(decision["sweeps"][0]["q1_end_um"])
    assert plan.q_end[0, 5] == pytest.approx(np.radians(decision["sweeps"][0]["q6_end_deg"]))
    assert "re-identify extrinsics now with" in capsys.readouterr().out


def test_full_calibration_after_a_change_of_the_robot(capsys):
    _, sweeps = campaign(3, sessions=4, change=step_of_beta_4(), changed=3)
    write_sweeps("step.csv", sweeps, CELL)
    decision = decided("step.csv")["decision"]
    assert decision["action"] == "full"
    assert len(decision["sweeps"]) == 69
    assert "full calibration now (69 sweeps" in capsys.readouterr().out


def test_clock_times(capsys):
    write_sweeps("clock.csv", replace(SWEEPS, utc=np.array(UTC)), CELL)
    decision = decided("clock.csv", "--now", "2024-05-01T14:36:00Z")["decision"]
    assert decision["now_h"] == pytest.approx(8.1)
    assert decision["hold_until"].startswith("2024-05-01 15:")
    assert "hold until 2024-05-01 15:" in capsys.readouterr().out
    # This clock is years later: all the drift of these years is to be expected.
    assert decided("clock.csv", "--quiet")["decision"]["now_h"] > 10_000


def test_a_tolerance_out_of_reach_is_answered_with_the_least_that_is_not(week, capsys):
    decision = decided(week, "--tolerance-nm", "0.5", "-o", "none.csv")["decision"]
    shown = capsys.readouterr()
    assert (decision["action"], decision["hold_hours"], decision["sweeps"]) == ("hold", 0.0, [])
    assert "measure nothing: tolerance 0.5 nm cannot be met for circle: the best that can be met" in shown.out
    assert f"is {decision['attainable_nm']:.1f} nm" in shown.err
    assert len(Path("none.csv").read_text().splitlines()) == 1
    met = decided(week, "--tolerance-nm", f"{decision['attainable_nm']:.1f}")["decision"]
    assert met["attainable_nm"] is None
    assert met["probability_out"]["after"] <= 0.1


def test_what_is_refused(week, capsys):
    assert "lies in the future: 8 h, now is 7 h" in refused(capsys, week, "--now", "7")
    assert "unknown task 'cirle'" in refused(capsys, week, "--task", "cirle")
    assert "expected a number above zero" in refused(capsys, week, "--tolerance-nm", "-1")
    assert "between 0 and 1" in refused(capsys, week, "--level", "1.5")
    assert "expected two names" in refused(capsys, week, "-o", "a", "--json", "a")
    write_sweeps("few.csv", SWEEPS.take(SWEEPS.session != "day0"), CELL)
    assert "is no calibration" in refused(capsys, "few.csv")


def test_a_saved_track_is_taken_up_and_left_alone():
    write_sweeps("week.h5", SWEEPS, CELL)
    assert main(["track", "week.h5", "--quiet"]) == 0
    assert read_campaign("week.h5", CELL).track is not None
    before = file_sha256(Path("week.h5"))
    saved, fresh = decided("week.h5", "--quiet")["decision"], decided("week.csv", "--quiet")["decision"]
    assert saved["hold_hours"] == pytest.approx(fresh["hold_hours"], abs=0.02)
    assert file_sha256(Path("week.h5")) == before


def test_the_estimate_says_how_long_it_holds(week, capsys):
    held = []
    for arguments in ([], ["--tolerance-nm", "100"], ["--task", "circle", "--task", "tilt-x", "--level", "0.05"]):
        assert main(["track", week, "--estimate", "estimate.json", *arguments]) == 0
        held.append(read_estimate("estimate.json", CELL).valid_until_h)
    assert held[0] == pytest.approx(8.0 + decided(week, "--quiet")["decision"]["hold_hours"], abs=0.05)
    assert held[1] > held[0] > held[2]
    out = capsys.readouterr().out
    assert f"valid until {held[0]:.2f} h: P(circle > 50 nm) < 0.1" in out
    assert held[2] == 8.0
    assert "not valid: P(circle, tilt-x > 50 nm) is above 0.05 already" in out
    assert main(["track", week, "--task", "cirle"]) == 2
    assert "unknown task 'cirle'" in capsys.readouterr().err


def test_a_stale_estimate_is_told(week):
    decided(week, "--tolerance-nm", "50")
    assert main(["track", week, "--json", "track.json", "--quiet"]) == 0
    until = json.loads(Path("track.json").read_text())["valid_until_h"]
    told = [
        any("was valid until" in text for text in decided(week, "--now", str(now), "--quiet")["warnings"])
        for now in (until - 0.05, until + 0.5)
    ]
    assert told == [False, True]


def test_a_session_may_be_asked_to_look_in_every_direction(week):
    one = decided(week, "--now", "11", "--quiet")["decision"]
    two = decided(week, "--now", "11", "--least-sweeps", "2", "--quiet")["decision"]
    assert (len(one["sweeps"]), len(two["sweeps"])) == (1, 2)
    assert two["then_hold_hours"] > one["then_hold_hours"]
