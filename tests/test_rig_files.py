"""RIG.toml and tickets: what they say, and the message for everything that can be wrong in them."""

import math
import re

import numpy as np
import pytest
from rig_fixtures import write_rig, write_ticket

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.ticket import orders_of
from fpcal_bayes.rig.drivers.interface import Address
from fpcal_bayes.rig.reader import read_rig
from fpcal_bayes.rig.settings import IDSDevice, ProgramDevice


@pytest.fixture
def rig_file(tmp_path):
    return write_rig(tmp_path / "rig.toml")


def test_a_rig_is_read(femto, rig_file):
    rig = read_rig(rig_file, femto)
    assert [controller.driver for controller in rig.controllers] == ["pi-gcs2", "smaract-mcs2"]
    assert [joint.axis.channel for joint in rig.joints] == ["1", "2", "3", "1", "2", "3"]
    assert rig.joints[3].speed == pytest.approx(math.radians(20.0))
    assert rig.joints[0].tolerance == 0.005
    assert (rig.close, rig.repeats, rig.least_gap, rig.clock.speedup) == (0.03, 1, 100.0, 100.0)
    assert isinstance(rig.instrument, IDSDevice)
    assert rig.instrument.noise == pytest.approx(0.002)


def test_ports_have_their_usual_numbers(femto, rig_file):
    rig_file.write_text(rig_file.read_text().replace("127.0.0.1:0", "10.0.0.7"))
    rig = read_rig(rig_file, femto)
    found = [*(controller.address for controller in rig.controllers), rig.instrument.address]
    assert found == [Address("10.0.0.7", port) for port in (50000, 55551, 9090)]


def test_a_photodiode_is_a_command(femto, rig_file):
    text = rig_file.read_text()
    part = text[text.index("[interferometer]") : text.index("[joint]")]
    rig_file.write_text(text.replace(part, '[interferometer]\nrecord = "record.py {trace}"\n'))
    assert read_rig(rig_file, femto).instrument == ProgramDevice("record.py {trace}", 10.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"fpcal-rig/1"', '"fpcal-rig/2"', "key schema: expected 'fpcal-rig/1', found 'fpcal-rig/2'"),
        ('name = "emulated"', "name = 1", "key name: expected a line of text in quotes"),
        ("[session]", "[sessions]", "key sessions: unknown key, expected one of clock, controller, ..."),
        ("close_nm = 30", "close_nm = -1", "key session.close_nm: expected a number from 0 to 1e+10, found -1"),
        ("repeats = 1", "repeats = 1.5", "key session.repeats: expected a whole number from 0 to 100, found 1.5"),
        ("speedup = 100.0", "speedup = 0", "key clock.speedup: expected a number from 1 to 1e+06, found 0"),
        ('"pi-gcs2"', '"pi"', "key controller.E-712.driver: expected one of pi-gcs2, smaract-mcs2, found 'pi'"),
        ("servo_on = true", "servo_on = 1", "key controller.E-712.servo_on: expected true or false, found 1"),
        ('"127.0.0.1:0"', '"127.0.0.1:x"', "key controller.E-712.address: expected HOST or HOST:PORT, found ..."),
        ("timeout_s = 0.5", "timeout_s = inf", "key controller.E-712.timeout_s: expected a finite number, found inf"),
        ("q1 = {", "q7 = {", "key joint.q7: unknown key, expected one of q1, q2, q3, q4, q5, q6"),
        ("q4 = { speed_deg_s", "q4 = { speed_um_s", "key joint.q4.speed_um_s: unknown key, expected ..."),
        ("speed_um_s = 1500.0", 'speed_um_s = "2"', "key joint.q1.speed_um_s: expected a finite number, found '2'"),
        ("tolerance_um = 0.005, ", "", "key joint.q1.tolerance_um: expected a finite number, found None"),
        ('"MCS-3D"]', '"MCS2"]', "key joint.q4.controller: expected one of E-712, MCS2, found 'MCS-3D'"),
        ('q2 = {', 'q2 = { channel = "1",', "key joint.q2.channel: E-712 channel 1 moves q1 already, expected another"),
        ("noise_nm = 2.0", "", "key interferometer.noise_nm: expected a finite number, found None"),
        ('"auto"', '"new"', "key interferometer.namespace: expected one of auto, ids, sen, found 'new'"),
        ("[clock]", "[clock", "not a TOML file: ..."),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_rig(femto, rig_file, old, new, message):
    text = rig_file.read_text()
    assert old in text
    rig_file.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        read_rig(rig_file, femto)
    pattern = ".*".join(map(re.escape, f"{rig_file}: {message}".split("...")))
    assert re.fullmatch(pattern, str(caught.value))


def with_columns(path, **columns):
    """Add columns to a ticket; a value holds for all rows."""
    head, *rows = path.read_text().splitlines()
    path.write_text(
        "\n".join([",".join([head, *columns]), *(",".join([row, *map(str, columns.values())]) for row in rows)]) + "\n"
    )
    return path


def test_a_plan_is_a_ticket(femto, tmp_path):
    ticket = read_ticket(write_ticket(tmp_path / "t.csv", femto), femto)
    orders = orders_of(ticket)
    assert len(orders) == 69
    assert all(len(order.targets) == 1 and not order.group and not order.whole for order in orders)
    assert math.isnan(ticket.expires_h)


def test_readings_divide_the_way_in_equal_steps(femto, tmp_path):
    path = with_columns(write_ticket(tmp_path / "t.csv", femto, [0, 50]), readings=3, ticket="T7", expires_h=12.5)
    ticket = read_ticket(path, femto)
    assert (ticket.name, ticket.expires_h) == ("T7", 12.5)
    for order in orders_of(ticket):
        ways = (order.targets - order.start) / np.where(
            order.targets[-1] == order.start, 1.0, order.targets[-1] - order.start
        )
        moving = order.targets[-1] != order.start
        assert np.allclose(ways[:, moving], np.array([[1 / 3], [2 / 3], [1.0]]))
        assert order.labels == (f"{order.label}-1/3", f"{order.label}-2/3", order.label)
        assert order.group == order.label


def test_rows_of_a_group_are_one_drive(femto, tmp_path):
    plan = paper_protocol(femto, midpoints=True, session="s1")
    write_csv(tmp_path / "t.csv", plan, femto)
    orders = orders_of(read_ticket(tmp_path / "t.csv", femto))
    assert len(orders) == 69
    assert [label for order in orders for label in order.labels] == plan.label.tolist()
    twice = with_columns(write_ticket(tmp_path / "u.csv", femto), readings=2)
    for one, other in zip(orders, orders_of(read_ticket(twice, femto)), strict=True):
        assert one.labels == other.labels
        assert np.allclose(one.targets, other.targets, rtol=0.0, atol=1e-9)


def test_a_ticket_may_have_no_rows(femto, tmp_path):
    path = with_columns(write_ticket(tmp_path / "t.csv", femto), ticket="T8")
    path.write_text(path.read_text().splitlines()[0] + "\n")
    ticket = read_ticket(path, femto)
    assert ticket.plan is None
    assert orders_of(ticket) == []


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"readings": 1.5}, "row 2, column readings: expected a whole number from 0 to 1000, found 1.5"),
        ({"readings": "x"}, "row 2, column readings: expected a number, found 'x'"),
        (
            {"expires_utc": "soon"},
            "row 2, column expires_utc: expected ISO 8601 as in 2024-05-01T08:30:00Z, found 'soon'",
        ),
        ({"dl_um": 1.0, "sigma_um": 1.0}, "row 1: dl_um holds what was measured, expected a ticket or a plan"),
        ({"kind": "absolute"}, "row 2, column kind: only sweeps are driven, found absolute: leave that row out"),
        ({"nonsense": 1}, "row 1: unknown column 'nonsense', expected ..."),
    ],
)
def test_what_is_wrong_in_a_ticket(femto, tmp_path, columns, message):
    path = with_columns(write_ticket(tmp_path / "t.csv", femto), **columns)
    with pytest.raises(InputError) as caught:
        orders_of(read_ticket(path, femto))
    assert re.fullmatch(".*".join(map(re.escape, f"{path}: {message}".split("..."))), str(caught.value))
