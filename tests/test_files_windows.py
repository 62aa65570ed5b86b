"""What Windows sees, by stand-ins: no fcntl, no POSIX calls, and no open file that can be replaced."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

STAND_INS = """
import os, pathlib, sys, warnings

# What Windows has not.
for module in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[module] = None
for name in ("fork", "geteuid", "getuid", "pread", "pwrite", "sched_getaffinity", "sched_setaffinity"):
    delattr(os, name)
rename = pathlib.Path.replace

def replace(self, target):
    opened = {os.path.realpath(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd")}
    for path in (self, target):
        if os.path.realpath(path) in opened:
            raise PermissionError(13, "Access is denied", str(path))
    return rename(self, target)

pathlib.Path.replace = replace
# Without fcntl the lock of this system is a soft one, of which its library warns.
warnings.simplefilter("ignore")
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.files import exclusive
"""

HELP = """
import argparse
from fpcal_bayes.cli.main import make_parser

(commands,) = (a.choices for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
for name in commands:
    try:
        main([name, "--help"])
    except SystemExit as ended:
        assert ended.code == 0
# The options are one thing, what runs is another: each command's module is loaded.
import importlib, keyword
for name in commands:
    importlib.import_module(f"fpcal_bayes.cli.{name.replace('-', '_')}{'_' * keyword.iskeyword(name)}")
print(len(commands))
"""

ROUND_TRIP = """
from pathlib import Path

path = Path("campaign.h5")
for line in (
    "simulate -o campaign.h5",
    "identify campaign.h5 --json day0.json",
    "track campaign.h5 --estimate now.json",
    "track campaign.h5 --anew --estimate now.json",
    "decide campaign.h5 --json decision.json",
):
    assert main([*line.split(), "--quiet"]) == 0, line
with exclusive(path):
    assert main(["track", "campaign.h5", "--quiet"]) == 2
with exclusive(path) as require_same:
    require_same()
    # The lock keeps no handle on the file, so that it can be replaced.
    assert main(["simulate", "-o", "campaign.h5", "--quiet"]) == 0
    try:
        require_same()
    except ValueError as error:
        print(error)
# As many workers as there are cores, however the system counts them.
assert main(["study", "coverage", "--replicates", "1", "--protocol", "missing.csv"]) == 2
print(*sorted(path.name for path in Path().iterdir()))
"""

STORE = """
from pathlib import Path
import numpy as np
from toy_study import ToyStudy
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.study.run import run_study

study = ToyStudy(cell=load_cell("femto-st", mechanics="none"), seed=0)
for n in (2, 3):
    results, came = run_study(study, Path("study.jsonl"), n, workers=0)
    print(results["number"].tolist(), came)
"""


def on_windows(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests")))}
    return subprocess.run(
        [sys.executable, "-c", STAND_INS + script],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="tells which files are open by /proc"),
]


def test_every_command_has_its_help_and_can_be_loaded(tmp_path):
    done = on_windows(HELP, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: fpcal ") == int(done.stdout.splitlines()[-1]) >= 22


def test_the_way_from_sweeps_to_a_decision(tmp_path):
    done = on_windows(ROUND_TRIP, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "another fpcal is writing this file" in done.stderr
    assert "missing.csv: no such file" in done.stderr
    replaced, left = done.stdout.splitlines()
    assert "another program replaced or removed this file" in replaced
    # The lock leaves nothing behind.
    assert left == "campaign.h5 day0.json decision.json now.json"


def test_a_store_of_replicates_grows(tmp_path):
    done = on_windows(STORE, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["[0.0, 1.0] 2", "[0.0, 1.0, 2.0] 1"]
