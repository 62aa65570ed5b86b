"""Time and memory against size: rows from 10 to 100,000, free parameters from 6 to 60; and the exponents.

Processor seconds of one thread, so that what else runs on the machine counts little. An exponent is the slope of log
time against log size over the larger half of the sizes, where fixed costs no longer hide it.

    python benchmarks/scaling.py --json scaling.json
"""

import os

# NumPy reads these when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import json
import platform
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import scaling_ours as ours
import scaling_peers as peers
from measuring import Point, exponents, too_steep
from scaling_inputs import measured

from fpcal_bayes.infer import identify
from fpcal_bayes.io import load_cell
from fpcal_bayes.model import Cell

SIZES = (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)


def up_to(limit: int, *, least: int = 10, every: int = 1) -> list[int]:
    """Sizes that are measured."""
    return [n for n in SIZES[::every] if least <= n <= limit]


#: Decades, and three sizes for the slope of the largest.
_LARGE = sorted({*up_to(100_000, every=2), 30_000})
#: What is measured, by name: a function of the cell and the largest size wanted.
PARTS: dict[str, Callable[[Cell, int], Iterable[Point]]] = {
    "parameters": lambda cell, most: ours.by_parameters([6, 12, 21, 40, 60]),
    "rows": lambda cell, most: ours.by_rows(cell, up_to_most(_LARGE, most)),
    "filter": lambda cell, most: ours.by_session_rows(cell, up_to_most(_LARGE, most)),
    "sessions": lambda cell, most: ours.by_sessions(cell, up_to_most(up_to(300), most)),
    "poses": lambda cell, most: ours.by_poses(cell, up_to_most(_LARGE, most)),
    "traces": lambda cell, most: ours.by_traces(cell, up_to_most(up_to(300), most)),
    "plan": lambda cell, most: ours.by_candidates(cell, up_to_most(up_to(3000, least=100), most)),
    "report": lambda cell, most: ours.by_report_rows(cell, up_to_most(up_to(10_000, least=100, every=2), most)),
    "Pinocchio": lambda cell, most: peers.by_poses(cell, up_to_most(up_to(100_000, every=2), most)),
    "Newton": lambda cell, most: peers.by_inverse_poses(cell, up_to_most(up_to(3000), most)),
    "figaroh": lambda cell, most: peers.by_figaroh_poses(cell, up_to_most(up_to(1000), most)),
    # From fewer rows lmfit ends at a poorer minimum.
    "lmfit": lambda cell, most: peers.by_rows(cell, up_to_most(up_to(10_000, least=100, every=2), most)),
    "statsmodels": lambda cell, most: peers.by_steps(cell, up_to_most(up_to(1000), most)),
}
PEERS = ("Pinocchio", "Newton", "figaroh", "lmfit", "statsmodels")


def up_to_most(sizes: list[int], most: int) -> list[int]:
    """Those of some sizes that are not larger than wanted."""
    return [n for n in sizes if n <= most]


def measure(parts: list[str], most: int) -> tuple[list[Point], dict[str, str]]:
    """Measurements up to a size, and why peers that could not be measured were not."""
    cell = load_cell(mechanics="none")
    # Loads the kernels.
    identify(cell, measured(cell, 10))
    points: list[Point] = []
    absent: dict[str, str] = {}
    for name in parts:
        try:
            points.extend(PARTS[name](cell, most))
        except ImportError as error:
            if name not in PEERS:
                raise
            absent[name] = f"{error.name or name} is not installed"
    return points, absent


def machine() -> dict[str, float]:
    """What kind of machine it is, and how many other programs wanted a core in the last minutes."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {"cores": os.cpu_count() or 1, "gibibytes": memory / 2**30, "others": max(0.0, os.getloadavg()[2] - 1.0)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most-rows", type=int, default=SIZES[-1], help="largest size of any kind")
    parser.add_argument("--parts", nargs="+", choices=tuple(PARTS), default=list(PARTS), help="by default all")
    parser.add_argument("--json", type=Path, help="write the measurements")
    options = parser.parse_args()
    points, absent = measure(options.parts, options.most_rows)
    slopes = exponents(points)
    print("exponents: " + ", ".join(f"{what} {slope:.2f}" for what, slope in slopes.items()))
    if options.json is not None:
        content = {
            "points": [asdict(point) for point in points],
            "exponents": slopes,
            "absent": absent,
            "machine": machine(),
            "python": platform.python_version(),
            "numpy": np.__version__,
        }
        options.json.write_text(json.dumps(content, indent=1) + "\n")
    if late := too_steep(points):
        print(f"faster than linear: {late}", file=sys.stderr)
    return 1 if late else 0


if __name__ == "__main__":
    raise SystemExit(main())
