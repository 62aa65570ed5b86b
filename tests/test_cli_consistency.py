"""What all commands have in common: options, help, plain text when piped, completion."""

import argparse
import re
import subprocess
import sys

import pytest

from fpcal_bayes.cli.common import console
from fpcal_bayes.cli.main import main, make_parser
from fpcal_bayes.report.table import plain_table

(_ACTION,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
COMMANDS = _ACTION.choices


@pytest.mark.parametrize("name", COMMANDS)
def test_common_options_and_help(name):
    parser = COMMANDS[name]
    known = {option for action in parser._actions for option in action.option_strings}
    assert {"--help", "--cell", "--opd", "--quiet"} <= known
    assert parser.description.endswith(".")
    for action in parser._actions:
        assert action.help, f"{name} {action.option_strings or action.dest} has no help"
    assert max(map(len, (parser.epilog or "").splitlines()), default=0) <= 120


def test_the_help_names_every_step_in_its_order():
    text = make_parser().format_help()
    steps = [re.search(rf"fpcal {name}\b", text).start() for name in ("simulate", "doctor", "identify", "task-error")]
    steps += [re.search(rf"fpcal {name}\b", text).start() for name in ("control", "track", "decide", "report")]
    assert steps == sorted(steps)


def test_tables_have_no_colour_when_piped_and_nothing_when_quiet(tmp_path, capsys):
    file = str(tmp_path / "sweeps.csv")
    assert main(["simulate", "-o", file]) == 0
    capsys.readouterr()
    for command in (["identify", file], ["observe", file], ["doctor", file]):
        assert main(command) == 0
        assert "\x1b" not in capsys.readouterr().out
        assert main([*command, "--quiet"]) == 0
        assert capsys.readouterr().out == ""


def test_a_table_in_a_pipe_loses_no_column_and_no_text(capsys):
    heads, cells = [f"column {i} of many [nm]" for i in range(40)], [f"{'long ' * 8}{i}" for i in range(40)]
    table = plain_table("title " * 50, heads, words=range(40))
    table.add_row(*cells)
    out = console(argparse.Namespace(quiet=False))
    out.print(table)
    out.print("word " * 100)
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[0] == table.title.strip()
    assert re.split(r" {2,}", lines[3]) == cells
    assert all(f"column {i} of many nm" in lines[1] for i in range(40))
    assert lines[4] == ("word " * 100).strip()


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion(shell, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--print-completion", shell])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert "task-error" in out
    assert "tolerance-nm" in out


#: What is slow to import, in the order of what it costs.
SLOW = {"numba", "scipy", "scipy.stats", "emcee", "arviz", "matplotlib", "numpy", "h5py", "rich", "shtab", "jinja2"}


def modules_after(script: str) -> set[str]:
    """What a program has imported at its end."""
    script = f"import sys; {script}; print(*sys.modules)"
    return set(
        subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    )


def test_help_starts_fast():
    assert not SLOW & modules_after("from fpcal_bayes.cli.main import make_parser; make_parser()")


def test_identify_imports_no_more_than_it_needs():
    assert SLOW & modules_after("import fpcal_bayes.cli.identify") == {"numba", "numpy", "scipy", "h5py", "rich"}
