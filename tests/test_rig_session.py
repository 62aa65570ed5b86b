"""Sessions on the emulated cell: what is stored, what is refused, and that the axes stop."""

import json
import os
import shlex
import signal
import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from rig_fixtures import constant, live, write_rig, write_ticket
from test_rig_files import with_columns

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.ticket import orders_of
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.rig.agenda import Agenda, origin_of
from fpcal_bayes.rig.clock import Halt, Halted
from fpcal_bayes.rig.drivers.interface import DeviceError
from fpcal_bayes.rig.reader import read_rig
from fpcal_bayes.rig.route import ForbiddenMoveError, Guard, dry_run
from fpcal_bayes.rig.session import Failed
from fpcal_bayes.simulator.sweeps import noise_free

pytest.importorskip("pipython")


@pytest.fixture
def cell_live(femto, tmp_path):
    with live(femto, tmp_path, truth=constant(femto), speedup=1000.0) as found:
        yield found


def normalised(found, sweeps):
    return (sweeps.dl - noise_free(found.cell, found.lab.truth, sweeps)) / sweeps.sigma


def test_a_full_session_is_what_the_simulator_measures(cell_live, femto, tmp_path):
    ticket = write_ticket(tmp_path / "t.csv", femto)
    _, summary = cell_live.measure(ticket, tmp_path / "s.h5")
    assert (summary.rows, summary.done, summary.doubtful) == (69, 69, 0)
    sweeps = read_sweeps(tmp_path / "s.h5", femto)
    planned = read_ticket(ticket, femto).plan
    assert sweeps.label.tolist() == planned.label.tolist()
    # Positions read back are within tolerance of those asked for, two tolerances at a limit.
    tolerance = np.array([joint.tolerance for joint in cell_live.rig.joints])
    for read, asked in ((sweeps.q_start, planned.q_start), (sweeps.q_end, planned.q_end)):
        assert (np.abs(read - asked) <= 2.0 * tolerance).all()
    # Chi-square of 69 with sd sqrt(138).
    assert np.sum(normalised(cell_live, sweeps) ** 2) == pytest.approx(69.0, abs=4.0 * np.sqrt(138.0))
    assert np.allclose(sweeps.sigma, np.sqrt(2.0) * 0.002)
    assert (np.diff(sweeps.time_h) > 0.0).all()
    assert all(allowed for _, _, allowed in cell_live.lab.commanded)
    assert not (tmp_path / "s.h5.journal").exists()


def test_readings_share_their_start(cell_live, femto, tmp_path):
    ticket = with_columns(write_ticket(tmp_path / "t.csv", femto, [0, 2, 46]), readings=2)
    cell_live.measure(ticket, tmp_path / "s.csv")
    sweeps = read_sweeps(tmp_path / "s.csv", femto)
    assert len(sweeps) == 6
    assert sweeps.group.tolist() == [str(label) for label in sweeps.label[1::2] for _ in range(2)]
    assert np.abs(normalised(cell_live, sweeps)).max() < 5.0
    assert all(text.endswith("Z") for text in sweeps.utc)


def test_drift_and_mechanics_reach_the_reading(femto, tmp_path):
    class Bent:
        return_sd = np.zeros(6)

        def length_change(self, q, approach, time_h):
            return 0.001 * q[2]

    with live(femto, tmp_path, truth=paper_truth(femto), machine=Bent(), speedup=1000.0) as found:
        early = found.lab.length()
        # q3 along Xw: the guide bends by a thousandth of its travel.
        found.measure(write_ticket(tmp_path / "t.csv", femto, [45]), tmp_path / "s.h5")
        sweeps = read_sweeps(tmp_path / "s.h5", femto)
        travel = sweeps.q_end[0, 2] - sweeps.q_start[0, 2]
        left = sweeps.dl - noise_free(femto, found.lab.truth, sweeps)
        assert abs(travel) > 200.0
        assert left[0] == pytest.approx(0.001 * travel, abs=0.02)
        found.lab._time_h += 24.0
        assert abs(found.lab.length() - early) > 0.01


def test_a_sweep_that_does_not_close_is_driven_again_and_then_marked(cell_live, femto, tmp_path):
    move, slips = cell_live.lab.move, [0]

    def moved(joint, target):
        cell_live.lab.slipped += slips[0]
        return move(joint, target)

    def tell(progress):
        # Every move of the second sweep loses half a wavelength: one on the way out, one on the way back.
        slips[0] = int(progress.done == 1)

    cell_live.lab.move = moved
    ticket = write_ticket(tmp_path / "t.csv", femto, [45, 46, 47])
    agenda, summary = cell_live.measure(ticket, tmp_path / "s.h5", tell=tell)
    labels = [order.label for order in agenda.orders]
    assert summary.doubtful == 1
    campaign = read_campaign(tmp_path / "s.h5", femto)
    assert campaign.sweeps.label.tolist() == [labels[0], labels[2]]
    assert campaign.doubtful.label.tolist() == [labels[1]]
    assert campaign.doubtful.reason[0].startswith("does not close: 15")
    assert np.abs(normalised(cell_live, campaign.sweeps)).max() < 5.0


def test_three_disturbed_in_a_row_end_a_session_that_can_go_on(cell_live, femto, tmp_path):
    ticket = write_ticket(tmp_path / "t.csv", femto, [45, 46, 47, 48, 49])
    cell_live.rig = replace(cell_live.rig, repeats=0)

    def tell(progress):
        if progress.done == 1:
            cell_live.emulated.server.inject("IDS3010", "lost-fringe", 1e6)

    agenda, summary = cell_live.measure(ticket, tmp_path / "s.h5", tell=tell)
    assert (summary.rows, summary.done) == (1, 4)
    assert summary.reason.startswith("3 sweeps in a row are disturbed: the fringes are lost")
    cell_live.emulated.server.mend("IDS3010")
    agenda, summary = cell_live.measure(ticket, tmp_path / "s.h5")
    assert agenda.resumed
    assert (summary.rows, summary.doubtful, summary.reason) == (5, 0, "all sweeps are driven")


def test_a_kill_loses_no_drive_that_is_done(cell_live, femto, tmp_path):
    """The journal as a kill leaves it: the drive under way is gone, a line half written counts for nothing."""
    ticket = write_ticket(tmp_path / "t.csv", femto, [0, 1, 45, 46])
    halt = Halt()

    def tell(progress):
        if progress.done == 2:
            halt.request("enough")

    with pytest.raises(Failed) as caught:
        cell_live.measure(ticket, tmp_path / "s.h5", halt=halt, tell=tell)
    halt.close()
    assert isinstance(caught.value.__cause__, Halted)
    assert (caught.value.summary.rows, caught.value.unsure) == (2, [])
    before = read_sweeps(tmp_path / "s.h5", femto)
    (tmp_path / "s.h5").unlink()
    journal = tmp_path / "s.h5.journal"
    journal.write_text(journal.read_text() + '{"_id": 2, "doubt": "", "read')
    agenda, summary = cell_live.measure(ticket, tmp_path / "s.h5")
    assert agenda.resumed
    after = read_sweeps(tmp_path / "s.h5", femto)
    assert (summary.rows, len(after)) == (4, 4)
    assert (after.dl[:2] == before.dl).all()
    assert (after.time_h[:2] == before.time_h).all()
    with pytest.raises(InputError, match="exists: a session that is measured is not measured again"):
        cell_live.measure(ticket, tmp_path / "s.h5")


def test_axes_that_a_kill_left_on_their_way_are_stopped_first(cell_live, femto, tmp_path):
    """The program is gone in the middle of a move, and the axis goes on: where it is read to be it would not stand."""
    ticket, lab, done = write_ticket(tmp_path / "t.csv", femto, [0, 45]), cell_live.lab, []
    cell_live.measure(ticket, tmp_path / "first.h5")
    lab.axes[0].speed = 0.001
    lab.move(0, 140.0)
    stop, move = lab.stop, lab.move

    def stopped(joint):
        done.append((joint, lab.axes[joint].moving(lab.clock.now())))
        stop(joint)

    def moved(joint, target):
        done.append("move")
        return move(joint, target)

    lab.stop, lab.move = stopped, moved
    _, summary = cell_live.measure(ticket, tmp_path / "second.h5")
    assert done.index((0, True)) < done.index("move")
    assert summary.rows == 2
    assert np.abs(normalised(cell_live, read_sweeps(tmp_path / "second.h5", femto))).max() < 5.0


def test_a_journal_of_another_ticket_is_refused(cell_live, femto, tmp_path):
    (tmp_path / "s.h5.journal").write_text(json.dumps({"schema": "fpcal-measure/1", "ticket_sha256": "0"}) + "\n")
    with pytest.raises(InputError, match="left by another ticket, cell or rig: remove it to begin anew"):
        cell_live.measure(write_ticket(tmp_path / "t.csv", femto, [0]), tmp_path / "s.h5")


def test_tickets_that_are_out_of_date_or_used_up(cell_live, femto, tmp_path):
    ticket = write_ticket(tmp_path / "t.csv", femto, [45])
    cell_live.measure(ticket, tmp_path / "s.h5")
    campaign = read_sweeps(tmp_path / "s.h5", femto)
    with pytest.raises(InputError, match="session 's1' is in the campaign already: the ticket is used up"):
        cell_live.measure(ticket, tmp_path / "s2.h5", campaign=campaign)
    for columns, known, message in [
        ({"expires_utc": "2020-01-01T00:00:00Z"}, False, "the ticket expired at 2020-01-01T00:00:00.000Z"),
        ({"expires_h": 1.0}, False, "no campaign with clock times"),
        ({"expires_h": -1.0}, True, "the ticket expired at -1 h, now is "),
    ]:
        stale = with_columns(write_ticket(tmp_path / "u.csv", femto, [45], session="s2"), **columns)
        with pytest.raises(InputError, match=message):
            cell_live.measure(stale, tmp_path / "s2.h5", campaign=campaign if known else None)
    fresh = with_columns(write_ticket(tmp_path / "u.csv", femto, [45], session="s2"), expires_h=1000.0)
    cell_live.measure(fresh, tmp_path / "s2.h5", campaign=campaign)
    assert read_sweeps(tmp_path / "s2.h5", femto).time_h[0] > campaign.time_h[-1]
    future = replace(campaign, time_h=campaign.time_h + 1e4, utc=np.array([""] * len(campaign)))
    future.utc[0] = campaign.utc[0]
    later = replace(future, utc=np.array(["2999-01-01T00:00:00Z"]))
    with pytest.raises(InputError, match="before the campaign's last row: check the clocks"):
        cell_live.measure(fresh, tmp_path / "s3.h5", campaign=later)


@pytest.mark.parametrize("device", ["E-712", "MCS-3D", "IDS3010"])
def test_a_lost_device_stops_all_axes_and_the_next_run_goes_on(cell_live, femto, tmp_path, device):
    ticket = write_ticket(tmp_path / "t.csv", femto, [0, 45, 46])

    def tell(progress):
        if progress.done == 1:
            cell_live.emulated.server.inject(device, "reset", 1e6)

    with pytest.raises(Failed) as caught:
        cell_live.measure(ticket, tmp_path / "s.h5", tell=tell)
    assert isinstance(caught.value.__cause__, DeviceError)
    assert f"{device} at 127.0.0.1:" in str(caught.value.__cause__)
    assert len(caught.value.unsure) == (device != "IDS3010")
    began = max(axis.began for axis in cell_live.lab.axes)
    for name, stage in cell_live.emulated.stages.items():
        assert stage.stops[-1] >= began or name == device
    now = cell_live.rig.clock.now()
    assert not any(axis.moving(now) for axis in cell_live.lab.axes)
    cell_live.emulated.server.mend(device)
    _, summary = cell_live.measure(ticket, tmp_path / "s.h5")
    assert summary.rows == 3
    assert np.abs(normalised(cell_live, read_sweeps(tmp_path / "s.h5", femto))).max() < 5.0


def test_ctrl_c_stops_the_axes_within_50_ms(femto, tmp_path):
    """In the cell's own time, on a move of three seconds; a real signal, in the middle of it."""
    with live(femto, tmp_path, truth=constant(femto), speedup=1.0) as found:
        joints = tuple(replace(joint, speed=joint.speed / 20.0, settle_s=0.0) for joint in found.rig.joints)
        found.rig = replace(found.rig, joints=joints)
        sent = []

        def interrupt():
            while not any(axis.moving(found.rig.clock.now()) for axis in found.lab.axes):
                time.sleep(0.001)
            time.sleep(0.05)
            sent.append(time.time())
            os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        halt = Halt()
        thread.start()
        with halt.on_signals(), pytest.raises(Failed) as caught:
            found.measure(write_ticket(tmp_path / "t.csv", femto, [45]), tmp_path / "s.h5", halt=halt)
        thread.join()
        halt.close()
        assert str(caught.value) == "interrupted by SIGINT"
        stops = [[stop - sent[0] for stop in stage.stops] for stage in found.emulated.stages.values()]
        assert max(min(stop for stop in each if stop > -0.05) for each in stops) < 0.05
        assert caught.value.unsure == []
        assert not any(axis.moving(time.time()) for axis in found.lab.axes)
        assert not (tmp_path / "s.h5").exists()


def test_no_move_is_made_before_all_are_allowed(cell_live, femto, tmp_path):
    ticket = write_ticket(tmp_path / "t.csv", femto, [0, 1, 2])
    cell_live.rig = replace(cell_live.rig, least_gap=920.0)
    with pytest.raises(Failed, match=r"row \d: '.*': the mirror comes as near to the fibre as|comes as near"):
        cell_live.measure(ticket, tmp_path / "s.h5")
    assert cell_live.lab.commanded == []


def test_the_guard(femto, cell_live, tmp_path):
    class Keeper:
        together = ((0, 2), (3, 4, 5))

        def refusals(self, moves, speed):
            most = [np.max(stops, axis=0) for stops in moves]
            return ["q1 and q2 together" if q[0] > 50.0 and q[1] > 50.0 else None for q in most]

    guard = Guard(femto, cell_live.rig, envelope=Keeper())
    zero, corner = np.zeros(6), np.array([100.0, 100.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ForbiddenMoveError, match=r"^a move: q1 = 200 um is outside the limits of cell 'femto-st'"):
        guard.check_move(zero, 2.0 * corner, "a move")
    with pytest.raises(ForbiddenMoveError, match="q1 and q2 together"):
        guard.check_move(zero, corner, "a move")
    # From one allowed pose to another: axes that are not in step may pass through one that is not.
    with pytest.raises(ForbiddenMoveError, match="q1 and q2 together"):
        guard.check_move(corner * [1, 0, 0, 0, 0, 0], corner * [0, 1, 0, 0, 0, 0], "a move")
    guard.check_move(zero, corner * [1, 0, 0, 0, 0, 0], "a move")
    turns = guard.turns(zero, np.arange(1.0, 7.0))
    assert [np.flatnonzero(pose).tolist() for pose in turns] == [[0, 2], [0, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]]
    orders = orders_of(read_ticket(write_ticket(tmp_path / "t.csv", femto), femto))
    legs = dry_run(Guard(femto, cell_live.rig), orders, np.zeros(6))
    assert [len(moves) for moves in legs] == [3] * 69
    # Along the optical axis 40 um at 300 um/s: 385 fringes of 0.78 um a second.
    along = next(out for _, out, _ in legs if "-ty" in out.name)
    assert along.fringe_rate == pytest.approx(300.0 / 0.78, rel=0.01)
    assert along.seconds == pytest.approx(40.0 / 300.0 + 0.05, rel=1e-3)


def test_the_agenda_is_an_adaptive_experiment(cell_live, femto, tmp_path):
    ticket = read_ticket(write_ticket(tmp_path / "t.csv", femto, [0, 45]), femto)
    agenda = Agenda(ticket, femto, cell_live.rig, tmp_path / "s.h5", origin_of(ticket, None, 0.0))
    points = agenda.suggest(5)
    assert [point["_id"] for point in points] == [0, 1]
    assert points[1]["q3_end_um"] == 150.0
    assert agenda.suggest(1) == []
    assert agenda.should_stop() == (False, "")
    agenda.begin()
    reading = {"q": [0.0] * 6, "length_um": 1.0, "moment_s": 3600.0, "temperature_c": 20.0}
    end = reading | {"q": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], "length_um": 1.5, "moment_s": 7200.0}
    agenda.ingest([{"_id": 1, "doubt": "", "closing_um": 0.0, "readings": [reading, end]}])
    assert agenda.checkpoint() == 1
    sweeps = read_sweeps(tmp_path / "s.h5", femto)
    assert (sweeps.dl[0], sweeps.time_h[0], sweeps.temperature_c[0]) == (0.5, 2.0, 20.0)
    assert sweeps.utc[0] == "1970-01-01T02:00:00.000Z"
    again = Agenda(ticket, femto, cell_live.rig, tmp_path / "s.h5", origin_of(ticket, None, 0.0))
    assert [point["_id"] for point in again.suggest(5)] == [0]
    again.ingest([{"_id": 0, "doubt": "a lost fringe", "closing_um": None, "readings": []}])
    assert again.should_stop() == (True, "all sweeps are driven")


def test_the_command(cell_live, femto, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    empty = write_ticket(tmp_path / "empty.csv", femto)
    empty.write_text(empty.read_text().splitlines()[0] + "\n")
    assert main(shlex.split("measure empty.csv --rig missing.toml -o s.h5")) == 0
    assert capsys.readouterr().out == "empty.csv: no rows, nothing to measure\n"
    write_ticket(tmp_path / "t.csv", femto, [0, 45])
    assert main(shlex.split("measure t.csv --rig live.toml -o s.h5 --dry-run")) == 0
    told = capsys.readouterr().out
    assert "2 sweeps, 6 moves" in told
    assert "time s" in told
    assert "least gap um" in told
    assert not (tmp_path / "s.h5").exists()
    assert cell_live.lab.commanded == []
    assert main(shlex.split("measure t.csv --rig live.toml -o s.h5")) == 0
    assert "2 of 2 sweeps driven, 2 rows -> s.h5: all sweeps are driven" in capsys.readouterr().out
    assert len(read_sweeps("s.h5", femto)) == 2
    assert "E-712 > MOV" in (tmp_path / "s.log").read_text()
    cell_live.emulated.server.inject("MCS-3D", "reset", 1e6)
    assert main(shlex.split("measure t.csv --rig live.toml -o s2.h5")) == 2
    error = capsys.readouterr().err
    assert error.startswith("fpcal: error: MCS-3D at 127.0.0.1:")
    assert error.count("\n") == 1


def test_the_command_that_emulates(femto, tmp_path, monkeypatch, capsys):
    """Serves until a signal comes; faults of the file come at their times, and LIVE finds the devices."""
    fault = '\n[[emulate.fault]]\ndevice = "MCS-3D"\nkind = "reset"\nat_s = 1.0\nduration_s = 1e6\n'
    write_rig(tmp_path / "rig.toml", speedup=100.0, extra=fault)
    seen = []

    def look():
        while not (tmp_path / "rig_live.toml").exists():
            time.sleep(0.01)
        rig = read_rig(tmp_path / "rig_live.toml", femto)
        for controller in rig.controllers:
            with socket.create_connection((controller.address.host, controller.address.port), 5.0) as wire:
                time.sleep(0.2)
                seen.append(wire.recv(1) == b"" if controller.name == "MCS-3D" else True)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.chdir(tmp_path)
    thread = threading.Thread(target=look)
    thread.start()
    assert main(["rig", "--emulate", "rig.toml"]) == 0
    thread.join()
    assert seen == [True, True]
    assert "E-712 at 127.0.0.1:" in capsys.readouterr().out
