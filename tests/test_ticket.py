"""Tickets: what a decision asks for is what is measured, once, in time, and joins the campaign whole or not at all."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.analysis.append import append
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps, write_sweeps
from fpcal_bayes.io.tickets import read_ticket, write_plan, write_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.ticket import Ticket, check_measured
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")


def planned(n: int = 4, readings: int = 2, **others: float | str) -> Ticket:
    chosen = paper_protocol(CELL, session="extrinsic-1", time_h=30.0).take(np.arange(3, 3 + 5 * n, 5))
    return Ticket("ticket", chosen, np.full(n, readings), **others)  # type: ignore[arg-type]


def measured(plan: Sweeps, seed: int = 0) -> Sweeps:
    return simulate_um(CELL, paper_truth(CELL), plan, sigma=0.005, seed=seed)


@pytest.fixture(scope="module")
def calibration() -> Sweeps:
    return measured(paper_protocol(CELL))


@pytest.fixture
def campaign(tmp_path: Path, calibration: Sweeps) -> Path:
    path = tmp_path / "campaign.csv"
    write_sweeps(path, calibration, CELL)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
def test_a_plan_is_read_as_often_as_it_says(tmp_path, suffix):
    ticket = planned(readings=3)
    path = tmp_path / f"plan{suffix}"
    write_plan(path, ticket, CELL)
    rows, whole = read_sweeps(path, CELL, plan=True), read_sweeps(path, CELL, plan=True, whole=True)
    assert (len(rows), len(whole)) == (12, 4)
    assert len(set(rows.group.tolist())) == 4
    np.testing.assert_allclose(rows.q_end[2::3], whole.q_end, rtol=0, atol=1e-12)
    np.testing.assert_allclose(3 * rows.q_end[0::3], 2 * whole.q_start + whole.q_end, atol=1e-9)
    with pytest.raises(InputError, match="belongs to a plan"):
        read_sweeps(path, CELL)


def test_sweeps_of_one_label_do_not_share_a_start(tmp_path):
    plan = planned().plan
    same = Ticket("t", replace(plan, label=np.full(4, "q6")), np.full(4, 2))
    assert len(set(same.rows().group.tolist())) == 4
    assert Ticket("t", plan, np.array([1, 2, 1, 1])).rows().group.tolist().count("") == 3


def test_a_ticket_comes_back_as_it_was_written(tmp_path):
    ticket = planned(expires_h=34.0, expires_utc=1764345600.0, name="t-1")
    write_ticket(tmp_path / "t.csv", ticket, CELL)
    read = read_ticket(tmp_path / "t.csv", CELL)
    assert (read.expires_h, read.expires_utc, read.name) == (34.0, 1764345600.0, "t-1")
    np.testing.assert_array_equal(read.readings, ticket.readings)
    np.testing.assert_array_equal(read.plan.q_end, ticket.plan.q_end)


def test_what_a_ticket_asks_for_joins_the_campaign(tmp_path, campaign):
    for suffix in (".csv", ".h5"):
        write_ticket(tmp_path / "t.csv", planned(expires_h=34.0, name="t-1"), CELL)
        kept = tmp_path / f"kept{suffix}"
        write_sweeps(kept, read_sweeps(campaign, CELL), CELL)
        session = measured(read_sweeps(tmp_path / "t.csv", CELL, plan=True).take(np.arange(7)))
        write_sweeps(tmp_path / "s.csv", session, CELL)
        done = append(kept, tmp_path / "s.csv", CELL, ticket=tmp_path / "t.csv")
        assert (done.sessions, done.n_rows, done.n_missing, done.n_sessions) == (("extrinsic-1",), 7, 1, 2)
        np.testing.assert_array_equal(read_sweeps(kept, CELL).dl[-7:], read_sweeps(tmp_path / "s.csv", CELL).dl)
        assert read_ticket(tmp_path / "t.csv", CELL).plan is None
        assert append(kept, tmp_path / "s.csv", CELL, ticket=tmp_path / "t.csv").sessions == ()
        with pytest.raises(InputError, match="extrinsic-1"):
            append(kept, tmp_path / "s.csv", CELL)


def spoilt(session: Sweeps, how: str) -> Sweeps:
    rows = np.arange(len(session))
    match how:
        case "another session":
            return replace(session, session=np.full(len(session), "mine"))
        case "too late":
            return replace(session, time_h=session.time_h + 5.0)
        case "another sweep":
            return replace(session, q_end=session.q_end + np.where(rows[:, None] == 2, 5.0, 0.0))
        case "twice":
            return join([session, session.take(rows[:1])])
    raise AssertionError(how)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("another session", "expected extrinsic-1, the session of ticket, found 'mine'"),
        ("too late", "measured after the ticket expired at 34 h"),
        ("another sweep", "no row of ticket asks for it"),
        ("twice", "is the same sweep of the ticket"),
    ],
)
def test_what_no_ticket_asks_for_is_refused(how, message):
    ticket = planned(readings=1, expires_h=34.0)
    with pytest.raises(InputError, match=message):
        check_measured(ticket, spoilt(measured(ticket.rows()), how), CELL)


def test_joints_as_they_were_read_back_are_near_enough():
    ticket = planned(readings=2)
    session = measured(ticket.rows())
    off = np.random.default_rng(0).normal(size=session.q_end.shape) * np.where(CELL.joint_scales == 1.0, 0.02, 1e-5)
    assert check_measured(ticket, replace(session, q_end=session.q_end + off), CELL) == 0


def test_a_sweep_may_be_asked_for_twice_or_nearly_so():
    rows = planned(readings=1).rows()
    inward = np.where(CELL.joint_scales == 1.0, -np.sign(rows.q_end), 0.0)
    near = replace(rows, q_end=rows.q_end + 0.6 * inward)
    asked = join([rows, rows, near])
    ticket = replace(planned(), plan=asked, readings=np.ones(len(asked), dtype=np.int64))
    order = np.random.default_rng(1).permutation(len(asked))
    # Read where the nearest row of the ticket may be another one's.
    session = measured(asked.take(order))
    session = replace(session, q_end=session.q_end + 0.35 * np.tile(inward, (3, 1))[order])
    assert check_measured(ticket, session, CELL) == 0
    assert check_measured(ticket, session.take(np.arange(len(session) - 2)), CELL) == 2
    with pytest.raises(InputError, match="is the same sweep of the ticket, expected each once"):
        check_measured(ticket, join([session, session.take(np.array([0]))]), CELL)


@pytest.mark.parametrize("rename", ["Full-T0 ", "again"])
def test_a_session_that_is_there_is_refused_under_any_name(tmp_path, campaign, calibration, rename):
    again = replace(calibration, session=np.full(len(calibration), rename), time_h=calibration.time_h + 24.0)
    write_sweeps(tmp_path / "again.csv", again, CELL)
    before = campaign.read_bytes()
    with pytest.raises(InputError, match="full-T0"):
        append(campaign, tmp_path / "again.csv", CELL)
    assert campaign.read_bytes() == before


@pytest.mark.parametrize(
    ("column", "factor", "message"),
    [
        ("dl", 1e3, "column dl_um: expected .* um within .*: check units"),
        ("time_h", -0.1, "column time_h: found -3 h, expected after the calibration 'full-T0', which ends at 0 h"),
        ("time_h", 0.0, "column time_h: found 0 h, expected after"),
    ],
)
def test_what_would_spoil_the_campaign_is_refused(tmp_path, campaign, column, factor, message):
    write_ticket(tmp_path / "t.csv", planned(expires_h=34.0, name="t-1"), CELL)
    session = measured(read_sweeps(tmp_path / "t.csv", CELL, plan=True))
    write_sweeps(tmp_path / "s.csv", replace(session, **{column: getattr(session, column) * factor}), CELL)
    before = campaign.read_bytes()
    with pytest.raises(InputError, match=message):
        append(campaign, tmp_path / "s.csv", CELL, ticket=tmp_path / "t.csv")
    assert campaign.read_bytes() == before
    assert read_ticket(tmp_path / "t.csv", CELL).plan is not None


def test_a_decision_writes_a_ticket_or_empties_it(tmp_path, campaign, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["decide", "campaign.csv", "--now", "30", "-o", "t.csv", "--json", "d.json"]) == 0
    said = json.loads(Path("d.json").read_text())
    ticket = read_ticket("t.csv", CELL)
    assert said["decision"]["action"] == "extrinsic"
    assert said["ticket"] == {
        "ticket": ticket.name, "session": "extrinsic-1", "n_rows": len(ticket.rows()), "expires_h": 34.0
    }  # fmt: skip
    assert not {"dl_um", "sigma_um", "signed"} & set(Path("t.csv").read_text().splitlines()[0].split(","))
    capsys.readouterr()
    assert main(["identify", "t.csv"]) == 2
    assert "belongs to a plan" in capsys.readouterr().err
    shutil.copy("t.csv", "old.csv")
    assert main(["decide", "campaign.csv", "--now", "0.1", "-o", "t.csv"]) == 0
    assert read_ticket("t.csv", CELL).plan is None
    assert len(Path("t.csv").read_text().splitlines()) == 1
    before = campaign.read_bytes()
    assert main(["append", "campaign.csv", "nothing.csv", "--ticket", "t.csv"]) == 0
    assert campaign.read_bytes() == before
    for command in ("identify", "observe", "simulate --protocol", "plan --n 2 -o p.csv --after"):
        words = command.split()
        extra = ["-o", "x.csv"] if words[0] == "simulate" else []
        assert main([*words, "t.csv", *extra]) == 2
    assert not Path("x.csv").exists()
