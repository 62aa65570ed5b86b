"""Traces that other programs write, each read back to the numbers that went in."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from fpcal_bayes.cli.arguments import columns
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.traces import read_trace

TIME = 0.005 * np.arange(60)
JOINT = np.round(np.linspace(-3.0, 2.5, 60), 6)
LIGHT = np.round(2.0 + np.cos(TIME * 70.0), 6)
NAMED = columns("t=Time,joint=X,irradiance=CH1")


def rows(pattern: str, decimal: str = ".") -> str:
    lines = (
        pattern.format(t=t, x=x, v=v) for t, x, v in zip(TIME.tolist(), JOINT.tolist(), LIGHT.tolist(), strict=True)
    )
    return "\n".join(lines).replace(".", decimal) + "\n"


def hdf5(path: Path) -> None:
    # Arrays of version 7.3 lie transposed behind a block of 512 bytes that says MATLAB.
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("Time", TIME), ("X", JOINT), ("CH1", LIGHT)):
            file[name] = values[:, None]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def tdms(path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    channels = [("Time", TIME), ("X", JOINT), ("CH1", LIGHT)]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("Measured", name, values) for name, values in channels])


WRITERS: dict[str, Any] = {
    "scope.csv": "Model,DSO-X\nPoints,60\n\nTime,X,CH1,CH2\ns,um,V,V\n" + rows("{t},{x},{v},0.5"),
    "semicolons.txt": "Messung vom 3. Mai\nZeit: 12:00\nTime (s);X [um];CH1 [V]\n" + rows("{t};{x};{v}", ","),
    "lvm.lvm": "LabVIEW Measurement\t\nDecimal_Separator\t,\n***End_of_Header***\t\nTime\tX\tCH1\tComment\n"
    + rows("{t}\t{x}\t{v}", ","),
    "gcs.dat": "# VERSION = 1\n# SEPARATOR = 32\n# SAMPLE_TIME = 0.005\n# NAME0 = CH1\n# NAME1 = X\n# END_HEADER\n"
    + rows("{v} {x} "),
    "old.mat": lambda path: savemat(path, {"Time": TIME, "X": JOINT, "CH1": LIGHT}),
    "new.mat": hdf5,
    "labview.tdms": tdms,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_trace_of_another_program_is_read(tmp_path: Path, name: str) -> None:
    # The content tells, not the name of the file.
    file = tmp_path / f"{name.partition('.')[0]}.anything"
    written = WRITERS[name]
    if callable(written):
        written(file)
    else:
        file.write_bytes(written.encode("cp1252"))
    found = read_trace(file, 2.0, NAMED)
    for one, other in ((found.time_s, TIME), (found.joint, 2.0 * JOINT), (found.irradiance, LIGHT)):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_a_number_for_the_time_is_the_interval(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("X;CH1\n" + rows("{x};{v}", ","))
    found = read_trace(tmp_path / "a.txt", 1.0, NAMED | columns("t=0.005"))
    np.testing.assert_allclose(found.time_s, TIME)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("Time;Y;CH1\n" + rows("{t};{x};{v}"), r"row 1: expected the header t_s,joint,irradiance_v, found 'Time', 'Y'"),
        ("Time;X;CH1\n" + rows("{t};{x};{v}") + "1;2\n", "row 62: expected 3 fields, found 2"),
        ("Time;X;CH1\n" + rows("{t};{x};{v}")[:-1], "the file may be cut short"),
        ("Time;X;CH1\nnothing\n", "expected the header .*, found 'Time;X;CH1'"),
        ("Time;X;CH1\n0;1;2\n1;1e999;3\n", "expected finite numbers"),
    ],
)
def test_what_cannot_be_read_says_what_was_found(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError, match=why):
        read_trace(tmp_path / "a.txt", 1.0, NAMED)
