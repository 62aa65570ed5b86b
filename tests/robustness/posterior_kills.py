"""Kill ``fpcal sample``, resume it each time, and compare the draws with those of a run in peace.

The first kills come at chosen moments: while the first block is written, after a later one, and while the draws are
written. The others come at random ones. Each run is forked from this process, which has imported all it needs.

    python tests/robustness/posterior_kills.py tests/data/case_a.csv --kills 100
"""

import os

# NumPy reads this when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import contextlib
import io
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from fault_child import DEADLINE, Child, Outcome

from fpcal_bayes.cli.main import main as fpcal


def draws_of(path: Path) -> dict[str, bytes]:
    """The bytes of every array of the posterior and of the sampler's own group."""
    with h5py.File(path) as file:
        return {
            f"{group}/{name}": file[group][name][()].tobytes()
            for group in ("posterior", "sample_stats")
            for name in sorted(file[group])
        }


def kill_at(name: str, *, renamed: bool) -> Callable[[], None]:
    """What a child does so that it is killed when it has written `name` aside, before or after it gets its name."""

    def prepare() -> None:
        rename = Path.replace

        def replace(path: Path, target: Path) -> Path:
            if Path(target).name != name:
                return rename(path, target)
            if renamed:
                rename(path, target)
            os.kill(os.getpid(), signal.SIGKILL)
            raise AssertionError("killed")

        Path.replace = replace

    return prepare


#: What is written when the kill comes, whether it has its name by then, and how many blocks there are then at least.
MOMENTS = (("block-000000.npz", False, 0), ("block-000003.npz", True, 4), ("killed.nc", False, 5))


def kill_and_resume(sweeps: Path, folder: Path, *, kills: int, draws: int, seed: int) -> int:
    """Run once in peace, then once with kills, both into `folder`; how many kills met a run that was under way.

    `kills` come at random moments, after those at `MOMENTS`: mostly while blocks are written, sometimes before the
    first of them. A run that ends before its kill starts anew, and its draws count as well.

    Raises
    ------
    RuntimeError
        If a run fails, a kill loses a block, or draws differ from those of the run in peace.
    """
    settings = ("--draws", str(draws), "--seed", str(seed))

    def child(output: str, *more: str, prepare: Callable[[], None] = lambda: None) -> Child:
        return Child(("sample", str(sweeps), "-o", output, *settings, *more), folder, prepare)

    # What a command imports, by one that finds no input: the forked ones need not.
    with contextlib.redirect_stderr(io.StringIO()):
        fpcal(["sample", str(folder / "missing.csv"), "-o", str(folder / "none.nc"), "--quiet"])
    peaceful, killed = folder / "peaceful.nc", folder / "killed.nc"
    began = time.perf_counter()
    _require_done(child(peaceful.name).wait())
    duration, expected = time.perf_counter() - began, draws_of(peaceful)
    before: dict[str, int] = {}
    for name, renamed, least in MOMENTS:
        outcome = child(killed.name, "--resume", prepare=kill_at(name, renamed=renamed)).wait(kill_after=DEADLINE)
        if outcome.code is not None:
            raise RuntimeError(f"{name} was not written: {outcome}")
        # The time of each block: those that were there are taken up, and not written anew.
        blocks = {path.name: path.stat().st_mtime_ns for path in (folder / "killed.nc.blocks").glob("block-*.npz")}
        if len(blocks) < least or not before.items() <= blocks.items() or killed.exists():
            raise RuntimeError(f"killed at {name}: {sorted(blocks)}, expected {least} blocks or more, and no draws")
        before = blocks
    random, met = np.random.default_rng(seed), 0
    while met < kills:
        outcome = child(killed.name, "--resume").wait(kill_after=float(random.uniform(0.05, 1.0) * duration))
        if outcome.code is None:
            met += 1
            continue
        _compare(outcome, killed, expected)
        killed.unlink()
    _compare(child(killed.name, "--resume").wait(), killed, expected)
    left = sorted(path.name for path in folder.iterdir() if path not in (peaceful, killed, sweeps))
    # A kill while a file is written leaves that file aside; only whole files carry the names that are read.
    if any(name.endswith(".blocks") for name in left):
        raise RuntimeError(f"left behind: {', '.join(left)}")
    return met + len(MOMENTS)


def _require_done(outcome: Outcome) -> None:
    if outcome.code:
        raise RuntimeError(f"a run ended with exit status {outcome.code}: {outcome.errors}")


def _compare(outcome: Outcome, path: Path, expected: dict[str, bytes]) -> None:
    _require_done(outcome)
    if draws_of(path) != expected:
        raise RuntimeError("a resumed run gave other draws")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", metavar="FILE", type=Path, help="sweeps")
    parser.add_argument("--kills", type=int, default=100, help="at random moments, beside those at chosen ones")
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        met = kill_and_resume(
            options.file.resolve(), Path(folder), kills=options.kills, draws=options.draws, seed=options.seed
        )
    print(f"{met} kills, draws identical byte for byte")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
