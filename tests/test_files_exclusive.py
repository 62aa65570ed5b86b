"""One writer at a time: the lock on a file, and what `fpcal track` does about it."""

import os
import subprocess
import sys

import pytest

from fpcal_bayes.cli import track
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import exclusive, write_text

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
    real = track.record_of

    def replaced_meanwhile(*arguments):
        os.replace(other, path)
        return real(*arguments)

    monkeypatch.setattr(track, "record_of", replaced_meanwhile)
    assert main(["track", str(path), "--quiet"]) == 0
    assert "the states are not saved" in capsys.readouterr().err
    assert path.read_bytes() == expected
