"""Drivers and emulators speak the same wire; emulators also to clients that are not ours."""

import json
import re
import socket

import numpy as np
import pytest
from rig_fixtures import constant, live

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.rig.clock import Halt, Halted
from fpcal_bayes.rig.drivers import pi
from fpcal_bayes.rig.drivers.attocube import AttocubeIDS, IDSSettings
from fpcal_bayes.rig.drivers.interface import Address, CommandLog, DeviceError, Disturbed, shown
from fpcal_bayes.rig.drivers.link import Link
from fpcal_bayes.rig.drivers.pi import PIStage


@pytest.fixture
def cell_live(femto, tmp_path):
    with live(femto, tmp_path, truth=constant(femto), speedup=1000.0, timeout=0.2) as found:
        yield found


@pytest.fixture
def halt():
    found = Halt()
    yield found
    found.close()


@pytest.fixture
def bench(cell_live, halt):
    pytest.importorskip("pipython")
    found = cell_live.bench(halt, cell_live.folder / "commands.log")
    found.prepare()
    yield found
    found.close()
    found._log.close()


def talk(address: Address, data: bytes, answers: int, end: bytes) -> list[bytes]:
    """Say something over a bare socket, and the answers."""
    with socket.create_connection((address.host, address.port), 2.0) as wire:
        wire.sendall(data)
        heard = b""
        while heard.count(end) < answers:
            heard += wire.recv(4096)
    return heard.split(end)[:answers]


def several(ask):
    """The fault may come between two of them."""
    for _ in range(10):
        ask()


def wait(stages):
    while not all(stage.settled() for stage in stages):
        pass


def test_stages_move_and_read_back_in_model_units(bench, cell_live):
    target = np.array([10.0, -3.0, 42.5, np.radians(1.0), np.radians(-2.0), np.radians(75.0)])
    for stage in bench.stages:
        stage.move(target[list(stage.joints)])
    wait(bench.stages)
    # The encoders show half a nanometre of noise.
    assert np.allclose(bench.position(), target, rtol=0.0, atol=3e-3)
    # The E-712 counts from 0 to 300 um, its zero at 150.
    (line,) = talk(cell_live.emulated.server.endpoints["E-712"].address, b"POS? 3\n", 1, b"\n")
    assert float(line.removeprefix(b"3=")) == pytest.approx(192.5, abs=0.003)
    (line,) = talk(cell_live.emulated.server.endpoints["MCS-3D"].address, b":CHAN3:POS?\r\n", 1, b"\r\n")
    assert int(line) == pytest.approx(75_000_000_000, abs=10_000)


def test_the_length_is_that_of_the_cell(bench, cell_live):
    assert bench.instrument.length() == pytest.approx(cell_live.lab.length(), abs=0.02)
    assert np.isnan(bench.instrument.temperature_c())


@pytest.mark.parametrize("namespace", ["ids", "sen"])
def test_both_namespaces_of_the_ids(femto, tmp_path, halt, namespace):
    with live(femto, tmp_path, truth=constant(femto), namespace=namespace) as found:
        address = found.emulated.server.endpoints["IDS3010"].address
        log = CommandLog(None, found.rig.clock)
        link = Link("IDS3010", address, 0.5, halt, log)
        device = AttocubeIDS(link, IDSSettings(axis=0, air=True))
        device.prepare()
        assert device.length() == pytest.approx(found.lab.length(), abs=0.02)
        assert device.temperature_c() == 20.0
        other = {"ids": "sen", "sen": "ids"}[namespace]
        wrong = AttocubeIDS(link, IDSSettings(namespace=other))
        with pytest.raises(DeviceError, match="unknown to this instrument"):
            wrong.prepare()
        link.close()


def test_ids_requests_need_no_end_mark(cell_live):
    address = cell_live.emulated.server.endpoints["IDS3010"].address
    request = {"jsonrpc": "2.0", "method": "com.attocube.ids.displacement.getAbsolutePositions", "params": [], "api": 2}
    text = "".join(json.dumps(request | {"id": i}) for i in (1, 2))
    answers = [json.loads(line) for line in talk(address, text.encode(), 2, b"\r\n")]
    assert [answer["id"] for answer in answers] == [1, 2]
    assert answers[0]["result"][0] == 0
    assert answers[0]["result"][1] == pytest.approx(1e6 * cell_live.lab.length(), abs=2e4)
    (answer,) = talk(address, json.dumps(request | {"id": 3, "method": "com.attocube.no.such"}).encode(), 1, b"\r\n")
    assert json.loads(answer)["error"]["code"] == -32601
    (answer,) = talk(address, b"rubbish", 1, b"\r\n")
    assert "error" in json.loads(answer)


def test_mcs2_queues_its_errors(cell_live):
    address = cell_live.emulated.server.endpoints["MCS-3D"].address
    lines = b":CHAN1:MMOD 0\r\n:MOVE1 9000000000\r\n:NO:SUCH\r\n:SYST:ERR:COUN?\r\n:SYST:ERR?\r\n:SYST:ERR:COUN?\r\n"
    count, error, left = talk(address, lines, 3, b"\r\n")
    assert (count, left) == (b"2", b"1")
    assert b"out of range" in error


def test_pipython_with_its_own_socket_speaks_to_the_emulator(cell_live):
    pytest.importorskip("pipython")
    from pipython.pidevice.gcs2.gcs2commands import GCS2Commands
    from pipython.pidevice.gcserror import GCSError
    from pipython.pidevice.gcsmessages import GCSMessages
    from pipython.pidevice.interfaces.pisocket import PISocket

    address = cell_live.emulated.server.endpoints["E-712"].address
    with PISocket(address.host, address.port) as wire:
        device = GCS2Commands(GCSMessages(wire))
        assert device.qSAI() == ["1", "2", "3"]
        assert device.qTMX("1") == {"1": 300.0}
        device.SVO({"1": True, "2": True})
        device.MOV({"1": 160.0, "2": 140.0})
        while not all(device.qONT(["1", "2"]).values()):
            pass
        # The encoder shows half a nanometre of noise.
        assert device.qPOS(["1", "2"]) == pytest.approx({"1": 160.0, "2": 140.0}, abs=0.003)
        assert device.IsMoving("1") == {"1": False}
        assert device.IsControllerReady()
        with pytest.raises(GCSError, match=r"Position out of limits|\(7\)"):
            device.MOV("1", 301.0)
        device.STP(noraise=True)
    assert not any(position > 150.0 for _, position, allowed in cell_live.lab.commanded if allowed)


ADDRESS = r"127\.0\.0\.1:\d+"


@pytest.mark.parametrize(
    ("device", "kind", "message"),
    [
        ("E-712", "no-answer", rf"E-712 at {ADDRESS}: POS\? 1 2 3: no answer within 0.2 s"),
        ("E-712", "half-line", rf"E-712 at {ADDRESS}: .*: half an answer, '.*', within 0.2 s"),
        ("E-712", "reset", rf"E-712 at {ADDRESS}: POS\? 1 2 3: the device closed the connection"),
        ("MCS-3D", "no-answer", rf"MCS-3D at {ADDRESS}: :CHAN1:POS\?: no answer within 0.2 s"),
        ("MCS-3D", "half-line", rf"MCS-3D at {ADDRESS}: :CHAN1:POS\?: half an answer, '.*', within 0.2 s"),
        ("MCS-3D", "reset", rf"MCS-3D at {ADDRESS}: :CHAN1:POS\?: the device closed the connection"),
    ],
)
def test_a_failure_is_one_line_with_device_address_and_command(bench, cell_live, device, kind, message):
    cell_live.emulated.server.inject(device, kind, 1e6)
    with pytest.raises(DeviceError) as caught:
        several(bench.position)
    assert re.fullmatch(message, str(caught.value))
    if kind != "reset":
        # A late answer is never taken for another one's: the connection is gone.
        with pytest.raises(DeviceError, match="not connected"):
            bench.position()


@pytest.mark.parametrize(
    ("kind", "message"),
    [("no-answer", "no answer within"), ("half-line", "half an answer"), ("reset", "closed the connection")],
)
def test_failures_of_the_interferometer(bench, cell_live, kind, message):
    cell_live.emulated.server.inject("IDS3010", kind, 1e6)
    with pytest.raises(DeviceError, match=rf"IDS3010 at {ADDRESS}: .*getA.*{message}"):
        several(bench.instrument.length)


def test_lost_fringes_are_a_disturbance_and_no_failure(bench, cell_live):
    cell_live.emulated.server.inject("IDS3010", "lost-fringe", 1e6)
    with pytest.raises(Disturbed, match="the fringes are lost: contrast 1 permille"):
        bench.instrument.length()
    cell_live.emulated.server.mend("IDS3010")
    bench.instrument.length()


def test_what_the_stages_say_of_themselves(bench, cell_live):
    e712, mcs = bench.stages
    for device, kind, stage, message in [
        ("E-712", "following-error", e712, "Motion error: position error too large, servo is switched off"),
        ("MCS-3D", "end-stop", mcs, "channel 1: end stop"),
        ("MCS-3D", "following-error", mcs, "channel 1: following error"),
    ]:
        stage.prepare()
        cell_live.emulated.server.inject(device, kind, 1e6)
        with pytest.raises(DeviceError, match=message):
            stage.settled()
        cell_live.emulated.server.mend(device)


def test_what_makes_a_move_unsafe_is_refused(bench, cell_live):
    e712, mcs = bench.stages
    cell_live.emulated.stages["MCS-3D"]._referenced["2"] = False
    with pytest.raises(DeviceError, match="channel 2 is not referenced: do that by hand"):
        mcs.prepare()
    with pytest.raises(DeviceError, match=r"MOV .*: Position out of limits"):
        _reopened(e712).move(np.array([200.0, 0.0, 0.0]))
    cell_live.emulated.stages["MCS-3D"]._referenced["2"] = True
    with pytest.raises(DeviceError, match=r"MOVE: .*out of range"):
        _reopened(mcs).move(np.radians([9.0, 0.0, 0.0]))


def _reopened(stage):
    stage.prepare()
    return stage


def test_a_servo_that_is_off_is_not_switched_on_unasked(cell_live, halt):
    pytest.importorskip("pipython")
    cell_live.emulated.stages["E-712"]._servo["2"] = False
    address = cell_live.emulated.server.endpoints["E-712"].address
    axes = tuple(joint.axis for joint in cell_live.rig.joints[:3])
    link = Link("E-712", address, 0.5, halt, CommandLog(None, cell_live.rig.clock))
    with pytest.raises(DeviceError, match="the servo of axis 2 is off"):
        PIStage(link, (0, 1, 2), axes, np.ones(3), servo_on=False).prepare()
    PIStage(link, (0, 1, 2), axes, np.ones(3), servo_on=True).prepare()
    assert cell_live.emulated.stages["E-712"]._servo["2"]
    link.close()


def test_a_missing_library_names_the_extra(monkeypatch, halt, cell_live):
    monkeypatch.setattr(pi, "GCS2Commands", None)
    link = Link("E-712", Address("127.0.0.1", 1), 0.5, halt, CommandLog(None, cell_live.rig.clock))
    with pytest.raises(InputError, match=r'needs PIPython: pip install "fpcal-bayes\[rig\]"'):
        PIStage(link, (), (), np.ones(0), servo_on=False)


def test_a_device_that_is_not_there(halt, cell_live):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    link = Link("MCS-3D", Address("127.0.0.1", port), 0.5, halt, CommandLog(None, cell_live.rig.clock))
    with pytest.raises(DeviceError, match=rf"MCS-3D at 127.0.0.1:{port}: connect: cannot connect \(Connection refused"):
        link.open()


def test_a_wait_ends_at_once_when_all_must_stop(bench, cell_live, halt):
    cell_live.emulated.server.inject("MCS-3D", "no-answer", 1e6)
    halt.request("enough")
    with pytest.raises(Halted, match="enough"):
        bench.position()
    assert bench.stop() == []


def test_stop_says_what_it_is_not_sure_of(bench, cell_live):
    bench.go(np.zeros(6) + 1e-3, "a move")
    cell_live.emulated.server.inject("MCS-3D", "reset", 1e6)
    (doubt,) = bench.stop()
    assert re.fullmatch(rf"MCS-3D: not sure that its axes stand \(MCS-3D at {ADDRESS}: .*\)", doubt)


@pytest.fixture
def log(cell_live, tmp_path, monkeypatch):
    """A log on a clock that stands unless it is set: `said` has its lines without their times."""
    found = CommandLog(tmp_path / "c.log", cell_live.rig.clock)
    found.seconds = 0.0
    found.said = lambda: [line.split(" ", 1)[1] for line in (tmp_path / "c.log").read_text().splitlines()]
    monkeypatch.setattr("fpcal_bayes.rig.drivers.interface.time.monotonic", lambda: found.seconds)
    yield found
    found.close()


def exchange(log, device, *messages):
    """Requests and their answers."""
    for request, answer in zip(messages[::2], messages[1::2], strict=True):
        log.write(device, ">", request)
        log.write(device, "<", answer)


def test_the_log_counts_what_repeats(log):
    log.write("A", ">", "MOV 1 5")
    # Two and a half seconds of looks at a joint on its way, two questions each.
    for look in range(250):
        log.seconds = 0.01 * look
        exchange(log, "A", "POS?", f"{look}", "ONT?", f"on {look}")
    log.write("B", ">", "POS?")
    log.write("A", ">", "STP")
    lines = log.said()
    assert lines[:5] == ["A > MOV 1 5", "A > POS?", "A < 0", "A > ONT?", "A < on 0"]
    assert "A > POS? (99 alike before it)" in lines
    last = ["A > POS? (48 alike before it)", "A < 249", "A > ONT? (49 alike before it)", "A < on 249", "B > POS?"]
    assert lines[-6:] == [*last, "A > STP"]
    for question in ("POS?", "ONT?"):
        found = [re.fullmatch(rf"A > {re.escape(question)}(?: \((\d+) alike before it\))?", line) for line in lines]
        assert sum(1 + int(match[1] or 0) for match in found if match) == 250
    # Of 1,002 lines.
    assert len(lines) < 25


def test_requests_that_differ_in_their_number_are_alike_in_the_log(log):
    for number in range(9):
        method = "com.attocube.ids.displacement.getAbsolutePositions"
        exchange(log, "IDS", json.dumps({"method": method, "id": number}), json.dumps({"result": [0], "id": number}))
    log.write("IDS", "-", "the connection is lost")
    first, _, last, answer, remark = log.said()
    assert '"id": 0}' in first
    assert '"id": 8} (7 alike before it)' in last
    assert '"id": 8}' in answer
    assert remark == "IDS - the connection is lost"


@pytest.mark.parametrize(
    "command",
    [
        "MOV 1 5\n",
        "\x18",
        ":STOP1\r\n:STOP2\r\n",
        ":MOVE1 5\r\n",
        ":SYST:ERR?\r\n",
        ":CHAN1:STAT?\r\n:MOVE1 5\r\n",
        '{"jsonrpc": "2.0", "method": "com.attocube.ids.system.startMeasurement", "params": [], "id": 1}',
        "record trace.csv 'what? '",
    ],
)
def test_commands_stand_in_the_log_at_once_with_their_answers(log, command):
    for _ in range(3):
        log.write("A", ">", command)
        assert log.said()[-1] == f"A > {shown(command, 400)}"
        log.write("A", "<", "done")
        assert log.said()[-1] == "A < done"
    assert len(log.said()) == 6


def test_looks_after_a_command_are_none_that_repeat(log):
    looks = ["POS?", "1", "ERR?", "0"]
    for _ in range(2):
        exchange(log, "A", *looks)
        log.write("A", ">", "\x18")
        log.write("A", "-", "connected")
        log.write("A", ">", "\x18")
    asked = ["A > POS?", "A < 1", "A > ERR?", "A < 0"]
    assert log.said() == [*asked, r"A > \x18", "A - connected", r"A > \x18"] * 2


def test_the_last_look_stands_in_a_log_that_is_closed(log):
    exchange(log, "A", *["POS?", "1"] * 4, "POS?", "2")
    assert log.said() == ["A > POS?", "A < 1"]
    log.close()
    assert log.said() == ["A > POS?", "A < 1", "A > POS? (3 alike before it)", "A < 2"]
    log.write("A", ">", "POS?")
    log.check()


def test_what_is_said_between_a_look_and_its_answer(log):
    exchange(log, "A", "POS?", "1")
    log.write("A", ">", "POS?")
    log.write("A", "-", "slow")
    log.write("A", "<", "2")
    log.write("B", "<", "unasked")
    exchange(log, "A", "POS?", "3")
    assert log.said() == [*("A > POS?", "A < 1", "A > POS?", "A - slow", "A < 2", "B < unasked", "A > POS?", "A < 3")]


def test_writing_to_a_full_disk_never_raises(cell_live, tmp_path):
    (tmp_path / "full.log").symlink_to("/dev/full")
    log = CommandLog(tmp_path / "full.log", cell_live.rig.clock)
    exchange(log, "A", *["POS?", "1"] * 3, "STP", "0")
    with pytest.raises(InputError, match=r"full\.log: cannot be written \(No space left on device\)"):
        log.check()
    log.close()


def test_the_log_of_a_move(bench, cell_live):
    bench.go(np.zeros(6) + 1e-3, "a move")
    text = (cell_live.folder / "commands.log").read_text()
    for part in ("E-712 > MOV ", "MCS-3D > :MOVE1 ", "E-712 < 1=150", "IDS3010 > {", "connected to 127.0.0.1"):
        assert part in text
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z [\w-]+ [<>-] ", line) for line in text.splitlines())
    # Nothing is left out but looks: the error of a move is asked at once, and its answer stands below.
    assert re.search(r"E-712 > MOV .*\n.* E-712 > ERR\?\n.* E-712 < 0\n", text)
