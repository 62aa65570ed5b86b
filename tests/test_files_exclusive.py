"""One writer at a time: the lock on a file, and what `fpcal track` does about it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fpcal_bayes.analysis import keep
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import exclusive, replacing, write_text

HOLD = """
import sys, time
from pathlib import Path
from fpcal_bayes.core.files import exclusive
with exclusive(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_told_until_the_first_is_killed(tmp_path):
    path = tmp_path / "a.h5"
    write_text(path, "content")
    with subprocess.Popen([sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another fpcal is writing this file"), exclusive(path):
            pass
        holder.kill()
    with exclusive(path) as require_same:
        require_same()
    assert path.read_text() == "content"
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


#: Holds a file open as other programs do: HDF5 locks what it has open.
OPEN = """
import sys, time
import h5py
with h5py.File(sys.argv[1], sys.argv[2]) as file:
    if sys.argv[2] == "w":
        file["x"] = range(10000)
    print("open", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("mode", ["r", "r+", "w"])
def test_what_another_program_has_open_is_neither_damaged_nor_held_by_fpcal(mode, tmp_path, capsys):
    path = tmp_path / "campaign.h5"
    assert main(["simulate", "-o", str(path), "--quiet"]) == 0
    with subprocess.Popen([sys.executable, "-c", OPEN, str(path), mode], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "open\n"
        before = path.read_bytes()
        # Whoever only reads is in the way of those who must be alone; what is half written cannot be read.
        refused = {"r": ("track",), "r+": ("track", "simulate -o"), "w": ("track", "simulate -o", "doctor")}[mode]
        for command in refused:
            capsys.readouterr()
            assert main([*command.split(), str(path), "--quiet"]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert "another program" in line
            assert "has this file open: close it there" in line
            if Path("/proc/locks").exists():
                assert f"process {holder.pid})" in line
        assert path.read_bytes() == before
        holder.kill()
    assert [p.name for p in tmp_path.iterdir()] == ["campaign.h5"]


def test_every_writer_is_told_of_one_that_is_alone(tmp_path):
    path = tmp_path / "a.h5"
    write_text(path, "content")
    with subprocess.Popen([sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another fpcal is writing this file"):
            write_text(path, "new")
        assert path.read_text() == "content"
        holder.kill()
    write_text(path, "new")
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


@pytest.mark.parametrize("way", ["in its place", "into it"])
def test_what_alone_holds_is_checked_at_the_last_moment(way, tmp_path):
    path, other = tmp_path / "a.h5", tmp_path / "other"
    write_text(path, "old")
    other.write_text("of another program")

    def write():
        with exclusive(path), replacing(path) as temporary:
            temporary.write_text("mine")
            if way == "into it":
                path.write_text("of another program")
            else:
                os.replace(other, path)

    with pytest.raises(InputError, match="another program replaced or removed this file"):
        write()
    assert path.read_text() == "of another program"


def test_a_second_sample_is_told_and_the_first_goes_on(tmp_path, capsys):
    sweeps, out = tmp_path / "s.csv", tmp_path / "p.nc"
    assert main(["simulate", "-o", str(sweeps), "--quiet"]) == 0
    blocks = tmp_path / "p.nc.blocks"
    blocks.mkdir()
    for more in ([], ["--resume"]):
        with exclusive(blocks):
            assert main(["sample", str(sweeps), "-o", str(out), "--draws", "50", "--quiet", *more]) == 2
        assert "another fpcal is writing this file" in capsys.readouterr().err
        assert blocks.is_dir()
    assert not out.exists()


def test_a_file_that_was_replaced_is_noticed(tmp_path):
    path = tmp_path / "a.h5"
    write_text(path, "old")
    with exclusive(path) as require_same:
        require_same()
        write_text(path, "new")
        with pytest.raises(InputError, match="another program replaced or removed this file"):
            require_same()
        path.unlink()
        with pytest.raises(InputError, match="replaced or removed"):
            require_same()


def test_a_read_only_file_can_be_held(tmp_path):
    path = tmp_path / "a.h5"
    write_text(path, "content")
    path.chmod(0o444)
    with exclusive(path):
        pass


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"a\.h5: cannot be read"), exclusive(tmp_path / "a.h5"):
        pass


def test_track_is_alone_with_its_campaign(tmp_path, capsys):
    path = tmp_path / "campaign.h5"
    assert main(["simulate", "-o", str(path), "--quiet"]) == 0
    before = path.read_bytes()
    with exclusive(path):
        assert main(["track", str(path), "--quiet"]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "another fpcal is writing this file" in text
    assert path.read_bytes() == before
    assert main(["track", str(path), "--quiet"]) == 0
    assert path.read_bytes() != before


def test_track_does_not_overwrite_what_another_program_put_there(tmp_path, capsys, monkeypatch):
    path, other = tmp_path / "campaign.h5", tmp_path / "other.h5"
    for file, seed in ((path, "0"), (other, "1")):
        assert main(["simulate", "-o", str(file), "--seed", seed, "--quiet"]) == 0
    expected = other.read_bytes()
    real = keep.record_of

    def replaced_meanwhile(*arguments):
        os.replace(other, path)
        return real(*arguments)

    monkeypatch.setattr(keep, "record_of", replaced_meanwhile)
    assert main(["track", str(path), "--quiet"]) == 0
    assert "the states are not saved" in capsys.readouterr().err
    assert path.read_bytes() == expected
