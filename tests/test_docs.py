"""The documentation: its commands work and print what stands there, its pages build, its links lead somewhere."""

import io
import os
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from fpcal_bayes.cli import arguments
from fpcal_bayes.cli.main import main, make_parser

ROOT = Path(__file__).parent.parent
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)
NOT_RERUN = "<!-- not rerun"
#: Pages whose commands are run as they stand.
RERUN = (
    *("tutorial.md", "how-to/identifiability.md", "how-to/beams.md", "how-to/priors.md", "how-to/matlab.md"),
    "explanation/gauges.md",
)


def sessions(text: str) -> list[tuple[str, list[str], bool]]:
    """Commands of a page, the lines that stand below each, and whether they are to be run again."""
    found = []
    for marked, body in re.findall(rf"({NOT_RERUN}[^\n]*-->\n)?```console\n(.*?)```", text, flags=re.DOTALL):
        for part in re.split(r"^\$ ", body, flags=re.MULTILINE)[1:]:
            command, _, shown = part.partition("\n")
            found.append((command, [line for line in shown.splitlines() if line.strip()], not marked))
    return found


def plain(line: str) -> str:
    return " ".join(line.split())


def commands_of(page: Path) -> list[list[str]]:
    return [shlex.split(command) for command, _, _ in sessions(page.read_text(encoding="utf-8"))]


@pytest.mark.slow
@pytest.mark.parametrize("name", RERUN)
def test_commands_print_what_the_page_shows(name, tmp_path, monkeypatch):
    # As a user types them.
    monkeypatch.setattr(arguments, "MECHANICS", "stated")
    monkeypatch.chdir(tmp_path)
    ran = 0
    for command, shown, rerun in sessions((ROOT / "docs" / name).read_text(encoding="utf-8")):
        if not rerun:
            continue
        out, errors = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(errors):
            assert main(shlex.split(command)[1:]) == 0, errors.getvalue()
        printed = {plain(line) for line in (out.getvalue() + errors.getvalue()).splitlines()}
        for line in shown:
            assert line.strip() == "..." or plain(line) in printed, f"{command}: {line}"
        ran += 1
    assert ran > 1


def test_the_readme_shows_what_the_tutorial_shows():
    """So that its commands need not be run again."""
    shown = {
        (command, plain(line))
        for command, lines, _ in sessions((ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"))
        for line in lines
    }
    for command, lines, _ in sessions((ROOT / "README.md").read_text(encoding="utf-8")):
        for line in lines:
            assert line.strip() == "..." or (command, plain(line)) in shown, f"{command}: {line}"


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda path: path.name)
def test_commands_are_ones_that_the_program_knows(page):
    parser = make_parser()
    for words in commands_of(page):
        if words[0] == "fpcal":
            parser.parse_args(words[1:])


def test_scripts_and_tests_that_are_named_exist():
    for page in [*PAGES, ROOT / "README.md"]:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"(?:studies|tests|benchmarks|docs|data)/[\w/-]+\.(?:py|md|toml|png|csv)", text):
            assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_every_command_has_its_line_in_the_table_of_json():
    text = (ROOT / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
    for command in ("identify", "observe", "sample", "compare", "task-error", "plan", "track", "decide", "doctor"):
        assert f"| `{command}` |" in text


@pytest.mark.slow
def test_the_pages_build_without_a_warning(tmp_path):
    pytest.importorskip("sphinx")
    environment = os.environ | {"FPCAL_DOCS": "brief"}
    options = ["-W", "--keep-going", "-q", "-d", str(tmp_path / "doctrees"), str(ROOT / "docs"), str(tmp_path / "html")]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "html" / "tutorial.html").exists()
    assert "fpcal decide" in (tmp_path / "html" / "reference" / "cli.html").read_text(encoding="utf-8")
