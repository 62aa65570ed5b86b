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
PROGRAMS = {"--help": 0.25, "identify --help": 0.25, f"identify {SWEEPS} --json out.json --quiet": 0.0}
#: What an identification loads of others, and how many times as long as that it may take from start to end: beside
#: other programs both take up to half as long again.
LIBRARIES, MOST_LOADS = "import numba, h5py, scipy.optimize, rich.console", 1.8


def processor_time() -> float:
    """Of the programs that have ended, user and system, in s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run(words: list[str], folder: Path) -> None:
    """Run Python; as a user's, it keeps the byte code of what it imports."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run(
        [sys.executable, *words], cwd=folder, env=kept | {"PYTHONPATH": str(ROOT)}, check=True, capture_output=True
    )


def loading(folder: Path) -> float:
    """Least processor time of five loads of the libraries, in s."""
    times = []
    for _ in range(5):
        began = processor_time()
        run(["-c", LIBRARIES], folder)
        times.append(processor_time() - began)
    return min(times)


@pytest.mark.benchmark(timer=processor_time)
@pytest.mark.parametrize("line", PROGRAMS, ids=lambda line: line.replace(str(SWEEPS), "69 sweeps"))
def test_fpcal(benchmark: Any, line: str, tmp_path: Path) -> None:
    benchmark.extra_info["name"] = f"fpcal {line.replace(str(SWEEPS), 'sweeps.csv')}"
    benchmark.pedantic(run, (["-m", "fpcal_bayes", *line.split()], tmp_path), warmup_rounds=1, rounds=5)
    assert benchmark.stats["min"] < (PROGRAMS[line] or MOST_LOADS * loading(tmp_path))
