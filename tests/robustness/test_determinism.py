"""Same inputs, seed and version: the same JSON, run after run and whatever the number of cores."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from determinism import COMMANDS, timeless

from fpcal_bayes.cli.main import main, make_parser

threadpoolctl = pytest.importorskip("threadpoolctl")

#: The quick commands; the program runs them all.
QUICK = ("identify", "observe", "task-error", "control", "track")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Sweeps and an estimate."""
    made = tmp_path_factory.mktemp("determinism")
    assert main(["simulate", "-o", str(made / "sweeps.csv"), "--protocol", "paper-mid", "--quiet"]) == 0
    assert main(["identify", str(made / "sweeps.csv"), "--json", str(made / "estimate.json"), "--quiet"]) == 0
    return made


@pytest.mark.slow
@pytest.mark.parametrize("command", QUICK)
def test_same_json_with_one_thread_and_with_two(folder, command, monkeypatch):
    monkeypatch.chdir(folder)
    found = []
    for threads in (1, 2):
        with threadpoolctl.threadpool_limits(threads):
            assert main([*COMMANDS[command].split(), "--json", "out.json", "--quiet"]) == 0
        found.append(timeless(json.loads(Path("out.json").read_text())))
    assert found[0] == found[1]


def test_the_program_runs_every_command_that_writes_json():
    (commands,) = (a.choices for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    writing = {name for name, parser in commands.items() if "--json" in parser.format_help()}
    assert set(COMMANDS) == writing


def test_commands_use_one_thread_of_blas_unless_told_otherwise():
    """With more, sums over many rows come out otherwise in their last digits."""
    look = (
        "import fpcal_bayes.cli.main, scipy.linalg, threadpoolctl;"
        "print({one['num_threads'] for one in threadpoolctl.threadpool_info() if one['user_api'] == 'blas'})"
    )
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    plain = {name: value for name, value in os.environ.items() if name not in names}
    found = subprocess.run([sys.executable, "-c", look], env=plain, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "{1}"
