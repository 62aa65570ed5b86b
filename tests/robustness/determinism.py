"""Same inputs, seed and version: does every command give the same, run after run, on one core and on two?

Compared are the JSON and every file beside it. Each command runs as a program of its own: twice bound to one core, and
on all cores.

    python tests/robustness/determinism.py
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from fault_child import meaning

#: The only values that tell how long a run took (in `fit`, `sampler` or beside a model), and the hash that covers them.
TIMED = {"seconds", "content_sha256", "issued_utc"}

#: What is needed first, and then each command that writes JSON; the slower ones on a small task.
INPUTS = (
    "simulate -o sweeps.csv --protocol paper-mid",
    "identify sweeps.csv --json estimate.json",
    "control --estimate estimate.json --task circle -o joints.csv",
    "simulate --path joints.csv --traces -o driven.csv",
    "simulate --traces -o index.h5",
    "decide sweeps.csv --tolerance-nm 500 -o ticket.csv",
    "simulate -o fresh.csv --seed 2",
)
COMMANDS = {
    "append": "append sweeps.csv driven.csv --ticket ticket.csv",
    "trace": "trace index.h5",
    "cell": "cell femto-st",
    "identify": "identify sweeps.csv",
    "observe": "observe sweeps.csv",
    "verify": "verify sweeps.csv --validation fresh.csv --task circle",
    "task-error": "task-error estimate.json --task spin --tolerance-nm 50",
    "control": "control --estimate estimate.json --task circle -o path.csv",
    "track": "track sweeps.csv",
    "decide": "decide sweeps.csv",
    "doctor": "doctor sweeps.csv",
    "certificate": "certificate estimate.json -o .",
    "report": "report sweeps.csv -o report.html",
    "plan": "plan --n 2 --draws 2 --candidates 40 -o plan.csv",
    "compare": "compare sweeps.csv --models opd=axis,opd=perpendicular",
    "sample": "sample sweeps.csv -o posterior.nc --draws 200",
    "ingest": "ingest index.h5 -o read.csv",
    "check": "check driven.csv --estimate estimate.json",
    "study": "study coverage --replicates 2 --workers 2 --anew -o study.jsonl",
}


def timeless(value: Any) -> Any:
    """A JSON value without the times that no two runs share."""
    if isinstance(value, dict):
        return {key: timeless(entry) for key, entry in value.items() if key not in TIMED}
    return [timeless(entry) for entry in value] if isinstance(value, list) else value


def files_of(folder: Path, inputs: set[str]) -> dict[str, Any]:
    """What the files say that a command left beside its JSON; pages byte by byte."""
    made = [path for path in sorted(folder.iterdir()) if path.name not in inputs and path.name != "out.json"]
    return {path.name: path.read_bytes() if path.suffix == ".html" else meaning(path) for path in made}


def run(line: str, folder: Path, *, cores: set[int]) -> int:
    """Run a command bound to some cores, with as many threads as its libraries like; its exit status."""
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in threads}
    command = [sys.executable, "-m", "fpcal_bayes", *line.split(), "--quiet"]
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stderr=subprocess.DEVNULL,
        check=False,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    ).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    options = parser.parse_args()
    everywhere = os.sched_getaffinity(0)
    one = {min(everywhere)}
    different = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for line in INPUTS:
            if run(line, folder, cores=everywhere):
                raise RuntimeError(f"{line}: failed")
        inputs = {path.name for path in folder.iterdir()}
        for command in options.only:
            found = []
            for cores in (one, one, everywhere):
                status = run(f"{COMMANDS[command]} --json out.json", folder, cores=cores)
                content = timeless(json.loads((folder / "out.json").read_text()))
                found.append((status, content, files_of(folder, inputs)))
                for path in folder.iterdir():
                    if path.name not in inputs:
                        path.unlink()
            same = found[0] == found[1] == found[2] and found[0][0] in (0, 1)
            different += [] if same else [command]
            beside = f", with {', '.join(found[0][2])}" if found[0][2] else ""
            print(f"{command:12} {'the same' if same else 'DIFFERENT'} (status {found[0][0]}){beside}", flush=True)
    same_ones = f"{len(options.only) - len(different)} of {len(options.only)} commands"
    print(f"{same_ones} give the same JSON and files on 1 and on {len(everywhere)} cores")
    return 1 if different else 0


if __name__ == "__main__":
    raise SystemExit(main())
