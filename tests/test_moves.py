"""Moves of the controllers: out and back without loss, and nothing that an axis cannot do."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import CONTROLLER_UNITS, load_cell
from fpcal_bayes.io.csv import read_records
from fpcal_bayes.io.moves import read_moves, write_order_moves
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.io.tickets import write_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.ticket import Ticket, orders_of
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.joints import ControllerAxis

CELL = load_cell(mechanics="none")


def counted(cell: Cell, axes: list[tuple[int, float, int]]) -> Cell:
    """The cell with controllers that count each axis by a sign, a zero and one of its units."""
    joints = []
    for j, (joint, (sign, zero, unit)) in enumerate(zip(cell.joints, axes, strict=True)):
        units = list(CONTROLLER_UNITS[joint.kind].items())
        name, per_unit = units[unit % len(units)]
        zero_of = round(zero * (1.0 if joint.kind == "prismatic" else 0.01) / per_unit, 6)
        joints.append(
            replace(joint, controller=ControllerAxis(f"C{j // 3}", str(j % 3), sign, zero_of, name, per_unit))
        )
    return replace(cell, joints=tuple(joints))


AXIS = st.tuples(st.sampled_from([1, -1]), st.floats(-500, 500), st.integers(0, 5))


@settings(max_examples=25, deadline=None)
@given(axes=st.lists(AXIS, min_size=6, max_size=6), readings=st.integers(1, 4))
def test_out_and_back(tmp_path_factory, axes, readings):
    cell, folder = counted(CELL, axes), tmp_path_factory.mktemp("moves")
    plan = paper_protocol(cell, session="extrinsic-3", time_h=7.5).take(np.arange(0, 69, 9))
    ticket = Ticket("ticket", plan, np.full(len(plan), readings))
    path = folder / "moves.csv"
    write_order_moves(path, orders_of(ticket), cell)
    found, meant = read_moves(path, cell), ticket.rows()
    np.testing.assert_allclose(found.q_start, meant.q_start, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.q_end, meant.q_end, rtol=0, atol=1e-10)
    for name in ("session", "label", "group", "time_h", "kind"):
        np.testing.assert_array_equal(getattr(found, name), getattr(meant, name))
    assert not found.measured


def test_limits_are_kept_however_an_axis_counts(tmp_path):
    """Of 100 random settings no position beyond a limit, in the words of the controller, comes in."""
    random, path = np.random.default_rng(0), tmp_path / "moves.csv"
    plan = paper_protocol(CELL).take(np.array([5]))
    for _ in range(100):
        axes = [(int(random.choice([-1, 1])), random.uniform(-500, 500), int(random.integers(6))) for _ in range(6)]
        cell, j = counted(CELL, axes), int(random.integers(5))
        write_order_moves(path, orders_of(Ticket("t", plan, np.array([1]))), cell)
        records = read_records(path)
        joint, at = cell.joints[j], records.header.index("position")
        beyond = random.choice([joint.low, joint.high]) * (1.0 + 1e-6) / cell.joint_scales[j]
        records.texts[j][at] = repr(float(joint.to_controller(beyond)))
        path.write_text("\n".join(",".join(row) for row in [records.header, *records.texts]) + "\n")
        with pytest.raises(InputError, match=f"row 7, column q{j + 1}_.* is outside the limits"):
            read_moves(path, cell)


def test_positions_are_those_of_the_controller(tmp_path):
    plan = paper_protocol(CELL).take(np.array([50]))
    write_order_moves(tmp_path / "m.csv", orders_of(Ticket("t", plan, np.array([1]))), CELL)
    table = read_records(tmp_path / "m.csv").columns()
    assert len(table["move"]) == 12
    for controller, channel, position in zip(
        table["controller"][6:], table["channel"][6:], table["position"][6:], strict=True
    ):
        j = next(
            j
            for j, joint in enumerate(CELL.joints)
            if joint.controller is not None
            and (joint.controller.name, joint.controller.channel) == (controller, channel)
        )
        shown = CELL.joints[j].to_controller(plan.q_end[0, j] / CELL.joint_scales[j])
        assert float(position) == pytest.approx(float(shown), abs=1e-12)


LOG = "move,controller,channel,unit,position,utc,length_um,sigma_um\n"


def log(cell: Cell, poses: list[list[float]], lengths: list[float]) -> str:
    lines = LOG
    for number, (pose, length) in enumerate(zip(poses, lengths, strict=True), 1):
        for joint, value in zip(cell.joints, pose, strict=True):
            axis = joint.controller
            assert axis is not None
            shown = float(joint.to_controller(value))
            utc = f"2026-11-28T08:{number:02d}:00Z"
            lines += f"{number},{axis.name},{axis.channel},{axis.unit},{shown!r},{utc},{length},0.005\n"
    return lines


def test_a_log_with_lengths_is_measured(tmp_path):
    poses = [[0, 0, 0, 0, 0, 0], [50, 0, 0, 0, 0, 0], [0, 0, -20, 1, 0, 0], [0, 0, -20, 1, 0, 45]]
    (tmp_path / "log.csv").write_text(log(CELL, poses, [920.0, 921.5, 930.0, 929.0]))
    assert main(["import", str(tmp_path / "log.csv"), "-o", str(tmp_path / "s.csv"), "--session", "hand"]) == 0
    found = read_sweeps(tmp_path / "s.csv", CELL)
    np.testing.assert_allclose(found.dl, [1.5, -1.0])
    np.testing.assert_allclose(found.q_end / CELL.joint_scales, [poses[1], poses[3]], atol=1e-9)
    np.testing.assert_allclose(found.time_h, [1 / 60, 3 / 60])
    assert found.sessions == ("hand",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1,E-712,1,um", "1,E-712,9,um", "column channel: E-712 9: expected one of"),
        ("1,E-712,1,um", "1,E-712,1,mm", "column unit: expected um, as the cell has it, found 'mm'"),
        ("2,", "0,", "expected moves in ascending order"),
        ("position,", "place,", "the column position is missing"),
        (",0.005", ",", "sigma_um of each change"),
        ("2,E-712,2,", "2,E-712,1,", "row 9, column channel: q1 stands twice in this move, expected once"),
        ("um,200.0,", "um,900.0,", "row 13, column q1_um: 750 um is outside the limits"),
    ],
)
def test_a_log_that_cannot_be_used(tmp_path, old, new, message):
    poses = [[0, 0, 0, 0, 0, 0], [50, 0, 0, 0, 0, 0]]
    text = log(CELL, poses, [920.0, 921.5])
    assert old in text
    at = text.rindex(f"\n{old}") if old == "2," else text.index(old) - 1
    (tmp_path / "log.csv").write_text(text[: at + 1] + text[at + 1 :].replace(old, new))
    with pytest.raises(InputError, match=message):
        read_moves(tmp_path / "log.csv", CELL)


def test_a_log_that_is_cut_short(tmp_path):
    poses = [[0, 0, 0, 0, 0, 0], [50, 0, 0, 0, 0, 0], [0, 0, -20, 1, 0, 0], [0, 0, -20, 1, 0, 45]]
    lines = log(CELL, poses, [920.0, 921.5, 930.0, 929.0]).splitlines(keepends=True)
    (tmp_path / "log.csv").write_text("".join(lines[:-4]))
    with pytest.raises(InputError, match="row 21: this move places 2 axes and all others 6: the log may be cut short"):
        read_moves(tmp_path / "log.csv", CELL)
    # A log of those axes alone that move is whole.
    moved = [lines[0], *lines[1:8], *lines[13:19], lines[24]]
    (tmp_path / "log.csv").write_text("".join(moved))
    np.testing.assert_allclose(read_moves(tmp_path / "log.csv", CELL).dl, [1.5, -1.0])


def test_joints_of_two_controllers_do_not_move_in_step(tmp_path):
    plan = paper_protocol(CELL).take(np.array([0]))
    both = replace(plan, q_end=plan.q_end + np.array([[30.0, 0, 0, 0, 0, 0]]))
    names = {joint.controller.name for joint in (CELL.joints[0], CELL.joints[3]) if joint.controller is not None}
    assert len(names) == 2
    with pytest.raises(InputError, match="moves q1, q4 in step, expected joints of one controller"):
        write_order_moves(tmp_path / "m.csv", orders_of(Ticket("t", both, np.array([1]))), CELL)
    assert not (tmp_path / "m.csv").exists()


def test_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_ticket("t.csv", Ticket("t", paper_protocol(CELL).take(np.arange(3)), np.full(3, 2)), CELL)
    assert main(["export", "t.csv", "-o", "moves.mat"]) == 0
    assert main(["import", "moves.mat", "-o", "s.csv"]) == 0
    assert "3 sweeps with 6 readings" in capsys.readouterr().out
    assert len(read_sweeps("s.csv", CELL, plan=True)) == 6
    assert main(["export", "s.csv", "-o", "again.csv"]) == 0
    assert main(["import", "again.csv", "-o", "again_sweeps.csv"]) == 0
    assert (tmp_path / "again_sweeps.csv").read_bytes() == (tmp_path / "s.csv").read_bytes()
