"""What goes wrong around a session: a full disk, a clock that is set, two programs, an edited rig, a late ticket."""

import errno
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from rig_fixtures import SteppedClock, constant, live, write_rig, write_ticket
from test_rig_files import with_columns

from fpcal_bayes.analysis.append import append
from fpcal_bayes.cli import measure
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.times import iso
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps, write_csv, write_sweeps
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.rig import reader
from fpcal_bayes.rig.bench import Bench, only_one
from fpcal_bayes.rig.clock import Clock, Halt
from fpcal_bayes.rig.results import sweeps_of
from fpcal_bayes.rig.route import ForbiddenMoveError, Guard
from fpcal_bayes.rig.session import Failed
from fpcal_bayes.simulator.sweeps import noise_free, simulate_um

pytest.importorskip("pipython")


@pytest.fixture
def cell_live(femto, tmp_path, monkeypatch):
    """A cell whose clock goes on when someone waits."""
    clock = SteppedClock(1.8e9)
    monkeypatch.setattr(reader, "Clock", lambda *_: clock)
    with live(femto, tmp_path, truth=constant(femto), timeout=20.0) as found:
        yield found


def good(found, output) -> int:
    """How many rows a session has, all of them right and each once."""
    sweeps = read_sweeps(output, found.cell)
    assert len(set(sweeps.label.tolist())) == len(sweeps)
    assert np.abs((sweeps.dl - noise_free(found.cell, found.lab.truth, sweeps)) / sweeps.sigma).max() < 5.0
    return len(sweeps)


def stand(found) -> bool:
    now = found.rig.clock.now()
    began = max(axis.began for axis in found.lab.axes)
    stopped = all(stage.stops[-1] >= began for stage in found.emulated.stages.values())
    return stopped and not any(axis.moving(now) for axis in found.lab.axes)


def test_a_log_that_cannot_be_written_stops_the_axes(cell_live, tmp_path):
    (tmp_path / "s.log").symlink_to("/dev/full")
    halt = Halt()
    bench = cell_live.bench(halt, tmp_path / "s.log")
    bench.prepare()
    with pytest.raises(InputError, match=r"s\.log: cannot be written \(No space left on device\)"):
        bench.go(np.zeros(6), "a move")
    assert cell_live.lab.commanded == []
    assert bench.stop() == []
    assert stand(cell_live)
    bench.close()
    halt.close()


def test_a_full_disk_loses_no_row_that_is_kept(cell_live, femto, tmp_path, monkeypatch):
    ticket, number, fsync = write_ticket(tmp_path / "t.csv", femto, [0, 1, 45, 46]), [0], os.fsync

    def full(handle):
        number[0] += 1
        if number[0] == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(Failed, match=r"s\.h5\.journal: cannot be written \(No space left on device\)"):
            cell_live.measure(ticket, tmp_path / "s.h5")
    assert stand(cell_live)
    _, summary = cell_live.measure(ticket, tmp_path / "s.h5")
    assert (summary.rows, good(cell_live, tmp_path / "s.h5")) == (4, 4)


def test_a_clock_that_is_set_back_spoils_no_row(cell_live, femto, tmp_path):
    clock = cell_live.rig.clock

    class SetBack(Clock):
        """Set back by an hour between the two readings of the second sweep."""

        def now(self):
            return clock.now() - 3600.0 * (len(cell_live.lab.commanded) > 9)

        def ticks(self):
            return clock.ticks()

        def wall(self, seconds):
            return clock.wall(seconds)

    ticket = write_ticket(tmp_path / "t.csv", femto, [0, 45, 46])
    cell_live.rig = replace(cell_live.rig, clock=SetBack())
    _, summary = cell_live.measure(ticket, tmp_path / "s.h5")
    assert (summary.rows, summary.doubtful, good(cell_live, tmp_path / "s.h5")) == (3, 0, 3)
    sweeps = read_sweeps(tmp_path / "s.h5", femto)
    assert (sweeps.t_end_h > sweeps.t_start_h).all()


def test_two_at_once_do_not_drive_one_cell(cell_live, femto, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_ticket(tmp_path / "t.csv", femto, [45])
    with only_one(cell_live.rig):
        assert main(["measure", "t.csv", "--rig", "live.toml", "-o", "s.h5"]) == 2
    error = capsys.readouterr().err
    assert "fpcal: error: E-712 at 127.0.0.1:" in error
    assert error.endswith(": another fpcal drives it: wait until it has ended\n")
    assert cell_live.lab.commanded == []
    assert main(["measure", "t.csv", "--rig", "live.toml", "-o", "s.h5"]) == 0


def test_a_rig_that_is_edited_does_not_go_on_with_a_session(cell_live, femto, tmp_path):
    ticket, halt = write_ticket(tmp_path / "t.csv", femto, [0, 45]), Halt()
    with pytest.raises(Failed):
        cell_live.measure(ticket, tmp_path / "s.h5", halt=halt, tell=lambda _: halt.request("enough"))
    halt.close()
    instrument = cell_live.rig.instrument
    for other in (replace(instrument, noise=0.01), replace(instrument, settings=replace(instrument.settings, sign=-1))):
        edited = replace(cell_live, rig=replace(cell_live.rig, instrument=other))
        with pytest.raises(InputError, match="left by another ticket, cell or rig: remove it to begin anew"):
            edited.measure(ticket, tmp_path / "s.h5")
    # Where a device is found may change: another port, a longer wait.
    cell_live.rig = replace(cell_live.rig, instrument=replace(instrument, timeout_s=30.0))
    assert cell_live.measure(ticket, tmp_path / "s.h5")[1].rows == 2


def test_sweeps_of_one_label_do_not_share_a_start(cell_live, femto, tmp_path):
    plan = paper_protocol(femto, session="s1").take(np.array([0, 45, 45]))
    write_ticket(tmp_path / "t.csv", femto, [0, 45, 45])
    lines = (tmp_path / "t.csv").read_text().replace(str(plan.label[0]), "q").replace(str(plan.label[1]), "q")
    (tmp_path / "t.csv").write_text(lines)
    cell_live.measure(with_columns(tmp_path / "t.csv", readings=2), tmp_path / "s.h5")
    sweeps = read_sweeps(tmp_path / "s.h5", femto)
    assert sweeps.group.tolist() == [f"q row {row}" for row in (2, 3, 4) for _ in range(2)]
    assert len(set(sweeps.t_start_h.tolist())) == 3


def test_times_and_approach_go_into_the_campaign(cell_live, femto, tmp_path):
    ticket = with_columns(write_ticket(tmp_path / "t.csv", femto, [0, 2, 46]), readings=2)
    for suffix in (".h5", ".csv"):
        output, campaign = tmp_path / f"s{suffix}", tmp_path / f"c{suffix}"
        cell_live.measure(ticket, output)
        first = simulate_um(femto, paper_truth(femto), paper_protocol(femto), sigma=0.005, seed=1)
        write_sweeps(campaign, replace(first, time_h=first.time_h - 24.0), femto)
        append(campaign, output, femto, now=cell_live.rig.clock.now())
        session, joined = read_sweeps(output, femto), read_sweeps(campaign, femto).of_session("s1")
        for name in ("t_start_h", "t_end_h", "approach", "utc", "group", "q_start", "q_end", "dl"):
            assert (getattr(joined, name) == getattr(session, name)).all(), name
        assert session.approach.tolist() == [text for text in ("000+00", "00000+", "0+0000") for _ in range(2)]
        # A joint that the sweep leaves alone stands still, whatever its encoder's noise.
        assert (np.count_nonzero(session.q_start != session.q_end, axis=1) == 1).all()
        assert ((session.t_start_h < session.t_end_h) & (session.t_end_h == session.time_h)).all()


def test_the_approach_is_the_last_way_that_was_gone():
    @dataclass
    class Turned:
        """Out by 10, back to 5."""

        start = np.zeros(2)
        targets = np.array([[10.0, 0.0], [5.0, 0.0]])
        session, group, labels = "s", "g", ("out", "back")

    readings = [
        {"q": q, "length_um": 0.0, "moment_s": 0.0, "temperature_c": None} for q in ([0, 0], [10, 1e-4], [5, 0])
    ]
    found = sweeps_of([Turned()], {0: {"doubt": "", "readings": readings}}, sigma=0.1, origin_s=0.0)
    assert found.approach.tolist() == ["+0", "-0"]
    assert (found.q_end[:, 1] == 0.0).all()


def test_starts_are_reached_from_the_side_that_the_rows_say(tmp_path, monkeypatch):
    """A start between the ends of the sweep before is reached from that sweep's end, to which rows say it stood."""
    cell = load_cell()
    plan = paper_protocol(cell, session="s1").take(np.arange(5))
    q1 = np.array([[0, 100], [60, 20], [40, 120], [120, 40], [80, 0]], dtype=float)
    start = np.zeros((5, 6))
    start[:, 0] = q1[:, 0]
    end = np.zeros((5, 6))
    end[:, 0] = q1[:, 1]
    write_csv(tmp_path / "t.csv", replace(plan, q_start=start, q_end=end), cell)
    sides, read, halt = [], Bench.read, Halt()

    def tell(progress):
        if progress.done == 3:
            halt.request("enough")

    clock = SteppedClock(1.8e9)
    monkeypatch.setattr(reader, "Clock", lambda *_: clock)
    with live(cell, tmp_path, truth=constant(cell), timeout=20.0) as found:

        def noted(bench, target):
            sides.append(found.lab.axes[0].approach)
            return read(bench, target)

        monkeypatch.setattr(Bench, "read", noted)
        # What goes on after a kill comes from the last row's end as well.
        with pytest.raises(Failed):
            found.measure(tmp_path / "t.csv", tmp_path / "s.h5", halt=halt, tell=tell)
        halt.close()
        found.measure(tmp_path / "t.csv", tmp_path / "s.h5")
    told = drive_of_sweeps(read_sweeps(tmp_path / "s.h5", cell), 1.0)
    # Of each sweep the start, the end and the return to the start are read.
    driven = np.array(sides).reshape(5, 3)
    assert (told.start_side[1:, 0] == driven[1:, 0]).all()
    assert (told.end_side[:, 0] == driven[:, 1]).all()


def test_a_ticket_that_expires_half_measured_is_followed_by_another(cell_live, femto, tmp_path, monkeypatch, capsys):
    """The cell keeps itself calibrated; a device is away for longer than the ticket holds; then it goes on."""
    monkeypatch.chdir(tmp_path)
    options = "--ticket ticket.csv --estimate now.json --rig live.toml --once --mechanics none"
    line = f"keep campaign.h5 {options}".split()
    clock, server, drives = cell_live.rig.clock, cell_live.emulated.server, [0]
    day0 = simulate_um(femto, constant(femto), paper_protocol(femto, midpoints=True), sigma=0.003, seed=1)
    utc, full = np.full(len(day0), iso(clock.now())), np.full(len(day0), "full-0")
    write_sweeps(tmp_path / "campaign.h5", replace(day0, utc=utc, session=full), femto)
    move = cell_live.lab.move

    def lost(joint, target):
        drives[0] += 1
        if drives[0] == 3:
            server.inject("IDS3010", "reset", 1e9)
        return move(joint, target)

    assert main(line) == 0
    clock.pass_until(clock.now() + 6 * 3600.0)
    cell_live.lab.move = lost
    assert main(line) == 2
    assert capsys.readouterr().err.count("fpcal: error: IDS3010 at 127.0.0.1:") == 1
    assert stand(cell_live)
    pending = read_ticket("ticket.csv", femto)
    assert len(json.loads(Path(f"campaign_extrinsic-1_{pending.name}.h5.journal").read_text().splitlines()[0])) > 3
    clock.pass_until(clock.now() + 5 * 3600.0)
    server.mend("IDS3010")
    assert main(line) == 0
    campaign = read_campaign("campaign.h5", femto)
    assert campaign.sweeps.sessions == ("full-0", "extrinsic-1")
    assert campaign.track is not None
    assert read_ticket("ticket.csv", femto).plan is None
    assert (campaign.sweeps.utc != "").all()
    assert all(allowed for _, _, allowed in cell_live.lab.commanded)


def test_moves_keep_to_the_prior_where_the_estimate_is_not_to_be_used(tmp_path, monkeypatch, capsys):
    """Some lengths of the calibration are wrong: what the fit says of tilts is not what keeps the mirror in sight."""
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).parent.parent / "data" / "femto-st.toml").read_text()
    Path("cell.toml").write_text(text.replace("max_tilt_deg = 30.0", "max_tilt_deg = 16.7"))
    cell, clock, guards = load_cell("cell.toml", mechanics="none"), SteppedClock(1.8e9), []
    sweeps = simulate_um(cell, constant(cell), paper_protocol(cell, midpoints=True), sigma=0.003, seed=1)
    found = identify(cell, sweeps).estimate
    wrong = np.zeros(len(sweeps))
    wrong[[14, 40, 66]] = 0.05, -0.08, 0.06
    write_sweeps("campaign.h5", sweeps.with_measurement(sweeps.dl + wrong, sweeps.sigma), cell)
    rig = write_rig(tmp_path / "rig.toml")

    def stopped(options, cell, rig, guard, *rest):
        guards.append(guard)
        raise InputError("stopped before the first move")

    monkeypatch.setattr(reader, "Clock", lambda *_: clock)
    monkeypatch.setattr(measure, "drive", stopped)
    line = "keep campaign.h5 --ticket ticket.csv --estimate now.json --rig rig.toml --once --mechanics none"
    assert main([*line.split(), "--cell", "cell.toml"]) == 2
    assert "stopped before the first move" in capsys.readouterr().err
    said = json.loads(Path("now.json").read_text())
    assert (said["trust"]["usable"], read_ticket("ticket.csv", cell).plan is None) == (False, False)
    (guard,) = guards
    there = np.radians([0.0, 0.0, 0.0, 4.9, 4.9, 0.0])
    known = Guard(cell, reader.read_rig(rig, cell), found)
    known.check_move(np.zeros(6), there, "known")
    with pytest.raises(ForbiddenMoveError, match=r"unknown: .*tilt"):
        guard.check_move(np.zeros(6), there, "unknown")
