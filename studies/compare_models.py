"""Can the data tell which length the interferometer sees? Both path models on data of either, over many truths.

Truths are drawn from the prior, the paper's 69 sweeps are simulated with 5 nm noise on the axis path or on the
perpendicular one, and `compare` judges both models. On perpendicular data it must reject the axis path every time,
and the axis fit must be bad by its own chi-square; on axis data it must never favour the perpendicular path.
"""

import os

# NumPy reads this when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import json
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from fpcal_bayes.infer import Comparison, ModelResult, compare, parse_models
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Truth, paper_protocol
from fpcal_bayes.report import plain_table
from fpcal_bayes.simulator import simulate_um

SIGMA = 0.005
PATHS = ("axis", "perpendicular")
MODELS = "opd=axis,opd=perpendicular"


def compare_once(made_on: str, number: int, *, seed: int, draws: int) -> Comparison:
    """Compare both models on the data of one truth; its random numbers depend on the arguments alone."""
    cell = load_cell(opd=made_on, mechanics="none")
    random = np.random.default_rng(np.random.SeedSequence([seed, PATHS.index(made_on), number]))
    values = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
    noise_seed, sampler_seed = random.integers(2**31, size=2).tolist()
    sweeps = simulate_um(
        cell, Truth(cell.free, np.zeros(1), values[None]), paper_protocol(cell), sigma=SIGMA, seed=noise_seed
    )
    return compare(cell, sweeps, parse_models(MODELS, cell), draws=draws, seed=sampler_seed)


def outcome(made_on: str, comparison: Comparison) -> dict[str, object]:
    """What a comparison says of the path the data were made on and of the other one."""
    by_path = {model.spec.opd: model for model in comparison.models}
    right, wrong = by_path[made_on], by_path[next(path for path in PATHS if path != made_on)]
    difference = comparison.differences[0] if comparison.differences else None
    gap = None if difference is None else (1 if difference.better == right.spec else -1) * difference.elpd
    return {
        "made_on": made_on,
        "judged": judged(right, wrong, gap, difference is not None and difference.clear),
        "elpd_difference": gap,
        "se": None if difference is None else difference.se,
        "at_least": None if difference is None else difference.at_least,
        "right": right.content(),
        "wrong": wrong.content(),
        "verdict": comparison.verdict,
    }


def judged(right: ModelResult, wrong: ModelResult, gap: float | None, clear: bool) -> str:
    """``right``, ``wrong`` or ``open``: which path was favoured."""
    if gap is not None:
        return "open" if not clear else "right" if gap > 0 else "wrong"
    if right.fits and not wrong.fits:
        return "right"
    return "wrong" if wrong.fits and not right.fits else "open"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truths", type=int, default=50, help="of each path (default: 50)")
    parser.add_argument("--first", type=int, default=0, help="number of the first truth")
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=PATHS, help="on which the data are made")
    parser.add_argument("--draws", type=int, default=300, help="effective draws (default: 300)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", dest="output", type=Path, help="outcome of every truth as JSON")
    options = parser.parse_args()

    table = plain_table(
        f"{options.truths} truths, {MODELS}",
        ["data of", "judged", "other path poor", "no minimum", "not sampled", "least chi2", "least gap", "bound", "s"],
    )
    numbers = range(options.first, options.first + options.truths)
    outcomes, good = [], True
    for path in options.paths:
        began = time.perf_counter()
        found = [
            outcome(path, compare_once(path, number, seed=options.seed, draws=options.draws))
            for number in track(numbers, path, console=Console(stderr=True), transient=True)
        ]
        outcomes += found
        counts = {word: sum(o["judged"] == word for o in found) for word in ("right", "open", "wrong")}
        poor = sum(not o["wrong"]["fits"] for o in found)
        states = [o["wrong"]["state"] for o in found]
        gaps = [o["elpd_difference"] for o in found if o["elpd_difference"] is not None]
        table.add_row(
            path,
            ", ".join(f"{n} {word}" for word, n in counts.items() if n),
            str(poor),
            str(states.count("no minimum")),
            str(states.count("not sampled")),
            f"{min(o['wrong']['chi2_data'] for o in found):.0f}",
            f"{min(gaps):.0f}" if gaps else "-",
            str(sum(bool(o["at_least"]) for o in found)),
            f"{time.perf_counter() - began:.0f}",
        )
        if path == "perpendicular":
            good &= counts["right"] == poor == options.truths
        else:
            good &= counts["wrong"] == 0
    Console(width=120, highlight=False).print(table)
    if options.output is not None:
        options.output.write_text(json.dumps(outcomes, indent=1))
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
