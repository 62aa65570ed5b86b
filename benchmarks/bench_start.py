"""Processor time of whole programs, from their start to their end: what a user waits for before any work is done."""

import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
SWEEPS = ROOT / "tests" / "data" / "case_a.csv"

#: Most seconds of processor time that a program may take; machine code is on disk.
PROGRAMS = {"--help": 0.25, "identify --help": 0.25, f"identify {SWEEPS} --json out.json --quiet": 1.1}


def processor_time() -> float:
    """Of the programs that have ended, user and system, in s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run(line: str, folder: Path) -> None:
    """Run one program; as a user's, it keeps the byte code of what it imports."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-m", "fpcal_bayes", *line.split()]
    subprocess.run(command, cwd=folder, env=kept | {"PYTHONPATH": str(ROOT)}, check=True, capture_output=True)


@pytest.mark.benchmark(timer=processor_time)
@pytest.mark.parametrize("line", PROGRAMS, ids=lambda line: line.replace(str(SWEEPS), "69 sweeps"))
def test_fpcal(benchmark: Any, line: str, tmp_path: Path) -> None:
    benchmark.extra_info["name"] = f"fpcal {line.replace(str(SWEEPS), 'sweeps.csv')}"
    benchmark.pedantic(run, (line, tmp_path), warmup_rounds=1, rounds=5)
    assert benchmark.stats["min"] < PROGRAMS[line]
