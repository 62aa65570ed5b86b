"""A photodiode's program in place of an interferometer: traces for `fpcal ingest`."""

import shlex
import sys
from dataclasses import replace

import numpy as np
import pytest
from rig_fixtures import constant, live, write_ticket
from test_rig_files import with_columns

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.rig.clock import Halt
from fpcal_bayes.rig.drivers.interface import CommandLog, DeviceError
from fpcal_bayes.rig.drivers.photodiode import PhotodiodeProgram
from fpcal_bayes.rig.session import Failed
from fpcal_bayes.rig.settings import ProgramDevice

pytest.importorskip("pipython")

#: Takes samples until its input is closed, as any program may; here those of a steady drive.
RECORDER = """\
import math, sys
trace, start, end = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
print("ready", flush=True)
sys.stdin.read()
lines = ["t_s,joint,irradiance_v"]
for i in range(201):
    x = start + (end - start) * i / 200
    lines.append(f"{i / 200:.4f},{x:.9f},{1 + math.cos(x):.6f}")
open(trace, "w").write("\\n".join(lines) + "\\n")
"""


def command(folder, text=RECORDER) -> str:
    (folder / "record.py").write_text(text)
    return shlex.join([sys.executable, "-I", "-S", str(folder / "record.py"), "{trace}", "{start}", "{end}"])


@pytest.fixture
def recording(femto, tmp_path):
    with live(femto, tmp_path, truth=constant(femto), speedup=1000.0) as found:
        found.rig = replace(found.rig, instrument=ProgramDevice(command(tmp_path), 10.0))
        found.folder = tmp_path / "s_traces"
        found.folder.mkdir()
        yield found


def test_a_session_of_traces(recording, femto, tmp_path):
    ticket = with_columns(write_ticket(tmp_path / "t.csv", femto, [0, 45]), readings=0)
    _, summary = recording.measure(ticket, tmp_path / "s.h5")
    assert (summary.rows, summary.done) == (2, 2)
    index = read_recordings(tmp_path / "s.h5", femto)
    assert [len(trace) for trace in index.traces] == [201, 201]
    for i, joint in enumerate((3, 2)):
        assert index.traces[i].joint[0] == pytest.approx(index.sweeps.q_start[i, joint], abs=1e-2)
        assert index.traces[i].joint[-1] == pytest.approx(index.sweeps.q_end[i, joint], abs=1e-2)
        assert np.count_nonzero(index.sweeps.q_start[i] != index.sweeps.q_end[i]) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("print()", "printed no line within"),
        ("print('ready', flush=True)\nimport sys\nsys.exit(3)", "ended with status 3"),
        ("print('ready', flush=True)\nimport sys\nsys.stdin.read()", "photodiode at record: .*: no such file"),
    ],
)
def test_a_program_that_fails_stops_the_cell(recording, femto, tmp_path, text, message):
    recording.rig = replace(recording.rig, instrument=ProgramDevice(command(tmp_path, text), 10.0))
    with pytest.raises(Failed, match=message) as caught:
        recording.measure(write_ticket(tmp_path / "t.csv", femto, [45]), tmp_path / "s.h5")
    assert caught.value.unsure == []
    assert all(stage.stops for stage in recording.emulated.stages.values())


def test_what_a_program_must_be_told(tmp_path, recording):
    halt = Halt()
    log = CommandLog(None, recording.rig.clock)
    with pytest.raises(InputError, match=r"expected a command in which \{trace\} stands for its file"):
        PhotodiodeProgram("record.py", tmp_path, 1.0, halt, log)
    program = PhotodiodeProgram(str(tmp_path / "missing {trace}"), tmp_path, 1.0, halt, log)
    with pytest.raises(DeviceError, match=r"photodiode at record: .*: cannot be started"):
        program.start(1.0, 0, 0.0, 1.0)
    halt.close()


def test_an_interferometer_has_no_traces(femto, tmp_path):
    with live(femto, tmp_path, truth=constant(femto)) as found:
        ticket = with_columns(write_ticket(tmp_path / "t.csv", femto, [45]), readings=0)
        with pytest.raises(InputError, match="row 2, column readings: 0 asks for a trace"):
            found.measure(ticket, tmp_path / "s.h5")
