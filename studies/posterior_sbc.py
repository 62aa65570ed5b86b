"""Is the posterior right? Simulation-based calibration (Talts et al. 2018) of all parameters and of a task.

A truth is drawn from the prior, sweeps are simulated from it, identified and sampled, and the truth is ranked among
the draws: if the sampler is right, every rank is equally likely. Ranked are the parameters, the change of cavity
length along a path that no sweep contains, and the log density itself, which shows a mode that is missed
(Modrak et al. 2023).
"""

import os

# NumPy reads this when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import json
import time
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy import stats

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.report.table import plain_table
from fpcal_bayes.study.sbc import (
    COVERAGES,
    FAMILY_WISE,
    PROTOCOLS,
    RANKED,
    Replicate,
    Verdict,
    judge,
    least_p,
    quantities,
    ranks_of,
)
from fpcal_bayes.study.sbc import sbc_plan as plan

SIGMA = 0.005


def run_replicate(number: int, *, protocol: str, seed: int, draws: int, steps: int | None = None) -> Replicate:
    """One truth; its random numbers depend on `seed`, the protocol and `number` alone.

    With `steps`, the walkers go so far and no further: the ranks are those of an exact sampler if the start is.
    """
    cell = load_cell()
    random = np.random.default_rng(np.random.SeedSequence([seed, PROTOCOLS.index(protocol), number]))
    return ranks_of(cell, plan(protocol, cell), random, sigma=SIGMA, draws=draws, steps=steps)


def run_protocol(
    protocol: str, numbers: range, seed: int, draws: int, processes: int, steps: int | None = None
) -> list[Replicate]:
    """Replicates in the order of their numbers."""
    one = partial(run_replicate, protocol=protocol, seed=seed, draws=draws, steps=steps)
    if processes == 1:
        return list(map(one, numbers))
    with get_context("spawn").Pool(processes) as pool:
        return list(pool.imap(one, numbers))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="number of the first replicate")
    parser.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=["paper", "random"])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--steps", type=int, help="stop each walker after so many steps, converged or not")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("-o", dest="output", type=Path, help="ranks as JSON; a figure stands beside it")
    options = parser.parse_args()

    cell, out = load_cell(), Console(width=120, highlight=False)
    names, ranks = quantities(cell), {}
    numbers = range(options.first, options.first + options.replicates)
    verdicts: dict[str, list[Verdict]] = {}
    for protocol in options.protocols:
        began = time.perf_counter()
        found = run_protocol(protocol, numbers, options.seed, options.draws, options.processes, options.steps)
        kept = np.array([r.ranks for r in found if r.ranks is not None])
        ranks[protocol] = kept
        unconverged = sum(bool(r.failures) for r in found)
        several = sum(r.charts > 1 for r in found)
        random = np.random.default_rng(options.seed)
        verdicts[protocol] = [judge(name, kept[:, i], random) for i, name in enumerate(names)]
        table = plain_table(
            f"{protocol}: {len(kept)} of {len(found)} replicates, {unconverged} not converged, {several} with several "
            f"charts, {time.perf_counter() - began:.0f} s",
            ["quantity", "p chi-square", "p Kolmogorov", *(f"in {100 * c:.0f} %" for c in COVERAGES), "corrected p"],
        )
        for verdict in verdicts[protocol]:
            shares = [f"{100 * share:.1f}" for share in verdict.covered]
            tests = [f"{verdict.chi_square:.4f}", f"{verdict.kolmogorov:.4f}"]
            table.add_row(verdict.name, *tests, *shares, f"{least_p(verdict):.4f}")
        out.print(table)
    n_tests = len(names) * len(verdicts)
    for protocol, each in verdicts.items():
        worst = min(each, key=least_p)
        corrected = min(1.0, n_tests * least_p(worst))
        good = corrected > FAMILY_WISE
        out.print(
            f"{protocol}: {'calibrated' if good else 'NOT calibrated'}, worst {worst.name}, p = {corrected:.3g} "
            f"over all {n_tests} quantities (family-wise level {FAMILY_WISE})"
        )
    if options.output is not None:
        content = {name: kept.tolist() for name, kept in ranks.items()}
        options.output.write_text(json.dumps({"quantities": names, "ranked": RANKED, "ranks": content}))
        draw_figures(names, ranks, options.output)
    return 0 if all(n_tests * least_p(v) > FAMILY_WISE for each in verdicts.values() for v in each) else 1


def draw_figures(names: list[str], ranks: dict[str, np.ndarray], beside: Path) -> None:
    """The distribution of each quantity's ranks less the uniform one, with simultaneous bands; a figure a protocol."""
    from matplotlib.figure import Figure

    level = 1.0 - FAMILY_WISE / (len(names) * len(ranks))
    for protocol, kept in ranks.items():
        n = len(kept)
        band = float(stats.kstwo.ppf(level, n))
        n_rows = -(-len(names) // 6)
        figure = Figure(figsize=(12.0, 1.8 * n_rows), layout="constrained")
        for axes, name, column in zip(
            figure.subplots(n_rows, 6, sharex=True, sharey=True).flat, names, kept.T, strict=False
        ):
            shares = (np.sort(column) + 0.5) / (RANKED + 1)
            axes.step(shares, np.arange(1, n + 1) / n - shares, where="post", linewidth=1.0)
            axes.axhspan(-band, band, alpha=0.15)
            axes.set_title(name, fontsize=8)
        figure.savefig(beside.with_name(f"{beside.stem}-{protocol}.png"), dpi=100)


if __name__ == "__main__":
    raise SystemExit(main())
