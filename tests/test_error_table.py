"""Every error of the documentation's table, provoked by the command that stands beside it."""

import re
import shlex
from pathlib import Path

import pytest
from error_folder import fill

from fpcal_bayes.cli.main import main

PAGE = Path(__file__).parent.parent / "docs" / "reference" / "errors.md"
ROWS = re.findall(r"^\| `(fpcal.*?)` \| `(.*)` \|$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("errors")
    fill(path)
    return path


def pattern(message: str) -> re.Pattern[str]:
    """The message, with ``...`` for anything."""
    return re.compile(".*".join(re.escape(part) for part in message.split("...")))


def test_the_table_is_long_and_covers_the_commands():
    assert len(ROWS) > 50
    assert len(set(ROWS)) == len(ROWS)
    commands = {row[0].split()[1] for row in ROWS if " " in row[0]}
    assert {
        "simulate",
        "ingest",
        "observe",
        "identify",
        "sample",
        "compare",
        "control",
        "check",
        "task-error",
    } <= commands
    assert {"plan", "track", "decide", "report", "doctor", "study", "week"} <= commands


@pytest.mark.parametrize(("command", "message"), ROWS, ids=[row[0] for row in ROWS])
def test_error(folder, monkeypatch, capsys, command, message):
    monkeypatch.chdir(folder)
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert main(shlex.split(command)[1:]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = [line for line in captured.err.splitlines() if not line.startswith("fpcal: compiling")]
    assert pattern(f"fpcal: error: {message}").fullmatch(line)
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def test_a_pattern_is_strict_outside_its_dots():
    assert pattern("a.csv: row 1: ... (x)").fullmatch("a.csv: row 1: anything (x)")
    assert not pattern("a.csv: row 1: ...").fullmatch("abcsv: row 1: anything")
    assert not pattern("a").fullmatch("ab")
