"""Time and memory against size: rows from 10 to 100,000, free parameters from 6 to 60; and the exponents.

Processor seconds of one thread, so that what else runs on the machine counts little. An exponent is the slope of log
time against log size over the larger half of the sizes, where fixed costs no longer hide it.

    python benchmarks/scaling.py --most-rows 100000 --json scaling.json
"""

import os

# NumPy reads these when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import json
import platform
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from fpcal_bayes.infer.identify import identify
from fpcal_bayes.infer.least_squares import minimise
from fpcal_bayes.infer.observe import observe
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.problem import Problem
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell, Joint, load_cell, make_parameters
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, UNITS
from fpcal_bayes.track.tracker import track

SIGMA = 0.005
#: Steps of the sampler whose time is compared; how many are needed does not depend on the number of rows.
STEPS = 40
#: Above this slope the cost does not count as linear: fixed costs per row shrink as batches fill the caches.
LINEAR = 1.1


@dataclass(frozen=True)
class Point:
    """One measurement: what, at which size, processor seconds, and the largest allocation in MiB."""

    what: str
    size: int
    seconds: float
    mebibytes: float


def random_sweeps(cell: Cell, n: int, seed: int = 0) -> Sweeps:
    """Sweeps of one joint each from anywhere to anywhere within the paper's ranges."""
    random = np.random.default_rng(seed)
    reach = np.where(cell.revolute, np.radians(5.0), 150.0)
    start = random.uniform(-reach, reach, (n, len(cell.joints)))
    joint = random.integers(len(cell.joints), size=n)
    end = start.copy()
    end[np.arange(n), joint] = random.uniform(-reach[joint], reach[joint])
    return Sweeps.make(start, end)


def measured(cell: Cell, n: int) -> Sweeps:
    """Random sweeps measured at the paper's truth."""
    return simulate(cell, paper_truth(cell), random_sweeps(cell, n), sigma=SIGMA, seed=1)


def sessions(cell: Cell, count: int, rows: int) -> Sweeps:
    """A full calibration, and sessions of some rows every hour."""
    parts = [paper_protocol(cell, session="full")]
    for number in range(1, count):
        plan = random_sweeps(cell, rows, seed=number)
        parts.append(replace(plan, session=np.full(rows, f"s{number:05d}"), time_h=np.full(rows, float(number))))
    return simulate(cell, paper_truth(cell), join(parts), sigma=SIGMA, seed=2)


def wide_cell(n_free: int) -> Cell:
    """A chain of eight joints with so many free parameters."""
    entries = {}
    for name in [*EXTRINSICS, *(f"{stem}_{i}" for i in range(1, 9) for stem in LINK_SLOTS)][:n_free]:
        stem = name if name in EXTRINSICS else name.rpartition("_")[0]
        entries[name] = (0.0, np.radians(0.1) if UNITS[stem] == "deg" else 1e-3 if stem == "gain" else 5.0, False)
    # The mirror faces the fibre, nearly a millimetre away.
    for name, nominal in (("y_wf", 920.0), ("beta_et", np.radians(-90.0))):
        entries[name] = (nominal, entries.get(name, (0.0, 0.0))[1], False)
    joints = tuple(Joint("revolute", -np.inf, np.inf, 0.0, None) for _ in range(8))
    return Cell(f"wide-{n_free}", joints, make_parameters(entries, 8), 1.56, "axis", "minus-y")


def timed(what: str, size: int, function: Callable[[], object]) -> Point:
    """Least processor seconds of some calls, one if it takes long, and the memory of one more."""
    seconds, repeats = np.inf, 0
    while repeats == 0 or (repeats < 6 and seconds < 0.3):
        began = time.process_time()
        function()
        seconds, repeats = min(seconds, time.process_time() - began), repeats + 1
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    point = Point(what, size, float(seconds), peak / 2**20)
    print(f"{what:28} {size:8}  {point.seconds:10.4f} s  {point.mebibytes:9.1f} MiB", flush=True)
    return point


def by_rows(cell: Cell, sizes: list[int]) -> list[Point]:
    """Commands against the number of rows."""
    points = []
    # Loads the kernels.
    observe(cell, measured(cell, 10))
    for n in sizes:
        sweeps = measured(cell, n)
        problem = Problem.of(CavityModel.of(cell), sweeps)
        values, rows = cell.free.nominal, problem.model.rows(sweeps.q_start, sweeps.q_end)
        points += [
            timed("Jacobian", n, lambda m=problem.model, v=values, r=rows: m.predict_with_jacobian(v, r)),
            timed("identify", n, lambda s=sweeps: identify(cell, s)),
            timed("observe", n, lambda s=sweeps: observe(cell, s)),
        ]
        if 30 <= n <= 1000:
            found = identify(cell, sweeps)
            points.append(timed(f"sample, {STEPS} steps", n, lambda f=found: sample(f, max_steps=STEPS)))
    # A calibration of 69 rows comes before what is measured here: rows in many sessions, and rows in one.
    for n in [n for n in sizes if 100 <= n <= 3_000]:
        many = sessions(cell, 1 + max(1, n // 6), 6)
        points.append(timed("track, 6 rows a session", n, lambda s=many: track(cell, s)))
    for n in [n for n in sizes if 100 <= n <= 30_000]:
        large = sessions(cell, 3, n)
        points.append(timed("track, 2 sessions each of", n, lambda s=large: track(cell, s)))
    return points


def by_parameters(sizes: list[int]) -> list[Point]:
    """Jacobian and one fit of 1,000 rows against the number of free parameters."""
    points = []
    for n in sizes:
        cell = wide_cell(n)
        truth = cell.free.nominal + 0.1 * cell.free.prior_sd * np.random.default_rng(3).standard_normal(n)
        at = Truth(cell.free, np.zeros(1), truth[None])
        sweeps = simulate(cell, at, random_sweeps(cell, 1000), sigma=SIGMA, seed=4)
        problem = Problem.of(CavityModel.of(cell), sweeps)
        rows = problem.model.rows(sweeps.q_start, sweeps.q_end)
        start = np.zeros(problem.n_unknowns)
        points += [
            timed("Jacobian, by parameters", n, lambda p=problem, r=rows, t=truth: p.model.predict_with_jacobian(t, r)),
            timed("minimise, by parameters", n, lambda p=problem, s=start: minimise(p, s)),
        ]
    return points


def exponents(points: list[Point]) -> dict[str, float]:
    """Slope of log time against log size over the larger half of the sizes, for each thing that was timed."""
    found = {}
    for what in dict.fromkeys(point.what for point in points):
        chosen = sorted((p.size, p.seconds) for p in points if p.what == what)
        # Three sizes at least, where there are so many.
        upper = np.log(np.array(chosen[min(len(chosen) // 2, max(0, len(chosen) - 3)) :]))
        if len(upper) > 1:
            found[what] = float(np.polyfit(upper[:, 0], upper[:, 1], 1)[0])
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most-rows", type=int, default=100_000)
    parser.add_argument("--json", type=Path, help="write the measurements")
    options = parser.parse_args()
    sizes = [n for n in (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000) if n <= options.most_rows]
    wide = by_parameters([6, 12, 21, 40, 60])
    points = by_rows(load_cell(), sizes)
    slopes = exponents(points) | exponents(wide)
    print("exponents: " + ", ".join(f"{what} {slope:.2f}" for what, slope in slopes.items()))
    late = {what: slope for what, slope in exponents(points).items() if slope > LINEAR}
    if options.json is not None:
        content = {
            "points": [asdict(point) for point in points + wide],
            "exponents": slopes,
            "python": platform.python_version(),
            "numpy": np.__version__,
        }
        options.json.write_text(json.dumps(content, indent=1) + "\n")
    if late:
        print(f"faster than linear in rows: {late}", file=sys.stderr)
    return 1 if late else 0


if __name__ == "__main__":
    raise SystemExit(main())
