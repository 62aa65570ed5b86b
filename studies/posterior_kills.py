"""Kill ``fpcal sample`` at random moments, resume it each time, and compare the draws with those of a run in peace."""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np


def draws_of(path: Path) -> dict[str, bytes]:
    """The bytes of every array of the posterior and of the sampler's own group."""
    with h5py.File(path) as file:
        return {
            f"{group}/{name}": file[group][name][()].tobytes()
            for group in ("posterior", "sample_stats")
            for name in sorted(file[group])
        }


def command(sweeps: Path, output: Path, draws: int, seed: int, *more: str) -> list[str]:
    """The command line of one run."""
    settings = ["--draws", str(draws), "--seed", str(seed), "--quiet"]
    return [sys.executable, "-m", "fpcal_bayes", "sample", str(sweeps), "-o", str(output), *settings, *more]


def kill_and_resume(
    sweeps: Path, folder: Path, *, kills: int, draws: int, seed: int, random: np.random.Generator
) -> int:
    """Run once in peace, then once with kills, both into `folder`.

    Each kill comes at a random moment: mostly while blocks are written, sometimes before the first of them. A run that
    ends before its kill starts anew, and its draws count as well.

    Returns
    -------
    int
        How many kills met a run that was under way.

    Raises
    ------
    RuntimeError
        If a run fails or its draws differ from those of the run in peace.
    """
    peaceful, killed = folder / "peaceful.nc", folder / "killed.nc"
    began = time.perf_counter()
    _finish(command(sweeps, peaceful, draws, seed))
    duration = time.perf_counter() - began
    expected, met = draws_of(peaceful), 0
    while met < kills:
        process = subprocess.Popen(command(sweeps, killed, draws, seed, "--resume"))
        try:
            process.wait(timeout=random.uniform(0.1, 1.0) * duration)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            met += 1
            continue
        _compare(process.returncode, killed, expected)
        killed.unlink()
    _finish(command(sweeps, killed, draws, seed, "--resume"))
    _compare(0, killed, expected)
    left = sorted(path.name for path in folder.iterdir() if path not in (peaceful, killed, sweeps))
    # A kill while a file is written leaves that file aside; only whole files carry the names that are read.
    if any(name.endswith(".blocks") for name in left):
        raise RuntimeError(f"left behind: {', '.join(left)}")
    return met


def _finish(arguments: list[str]) -> None:
    code = subprocess.run(arguments, check=False).returncode
    if code:
        raise RuntimeError(f"exit status {code}: {' '.join(arguments)}")


def _compare(code: int, path: Path, expected: dict[str, bytes]) -> None:
    if code:
        raise RuntimeError(f"a resumed run ended with exit status {code}")
    if draws_of(path) != expected:
        raise RuntimeError("a resumed run gave other draws")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", metavar="FILE", type=Path, help="sweeps")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder:
        random = np.random.default_rng(options.seed)
        met = kill_and_resume(
            options.file.resolve(), Path(folder), kills=options.kills, draws=options.draws, seed=0, random=random
        )
    print(f"{met} kills, draws identical byte for byte")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
