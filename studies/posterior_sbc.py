"""Is the posterior right? Simulation-based calibration (Talts et al. 2018) of all parameters and of a task.

Truths, ranks and tests are those of `fpcal study sbc`. Here all protocols are judged together, and the ranks are drawn.
"""

import os

# NumPy reads this when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import json
import time
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy import stats

from fpcal_bayes.io import load_cell
from fpcal_bayes.report import plain_table
from fpcal_bayes.study import FAMILY_WISE, PROTOCOLS, RANKED, PosteriorRanks, quantities, sbc_plan


@dataclass(frozen=True, kw_only=True)
class Ranks(PosteriorRanks):
    """The study of the package; the truths of each protocol are others."""

    protocol: str

    def random(self, number: int) -> np.random.Generator:
        """Random numbers of replicate `number`."""
        return np.random.default_rng([self.seed, PROTOCOLS.index(self.protocol), number])


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

    cell, out = load_cell(mechanics="none"), Console(width=120, highlight=False)
    names, ranks, worst = quantities(cell), {}, {}
    numbers = range(options.first, options.first + options.replicates)
    settings = {"cell": cell, "seed": options.seed, "draws": options.draws, "steps": options.steps}
    for protocol in options.protocols:
        began = time.perf_counter()
        study = Ranks(plan=sbc_plan(protocol, cell), protocol=protocol, **settings)
        with get_context("spawn").Pool(options.processes) as pool:
            found = list(pool.imap(study.replicate, numbers))
        results = {name: np.array([each[name] for each in found]) for name in study.shapes()}
        summary = study.summary(results)
        ranks[protocol] = results["ranks"][results["identified"] > 0].astype(int)
        worst[protocol] = min((row["p_corrected"], row["quantity"]) for row in summary.rows)
        table = plain_table(f"{protocol}: {summary.title}", [column.replace("_", " ") for column in summary.rows[0]])
        for row in summary.rows:
            table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
        out.print(table)
        for sentence in (summary.sentences[0], *summary.warnings):
            out.print(f"{protocol}: {sentence}")
        out.print(f"{protocol}: {time.perf_counter() - began:.0f} s")
    n_tests = len(names) * len(worst)
    for protocol, (p, name) in worst.items():
        corrected = min(1.0, n_tests * p)
        out.print(
            f"{protocol}: {'calibrated' if corrected > FAMILY_WISE else 'NOT calibrated'}, worst {name}, "
            f"p = {corrected:.3g} over all {n_tests} quantities (family-wise level {FAMILY_WISE})"
        )
    if options.output is not None:
        content = {name: kept.tolist() for name, kept in ranks.items()}
        options.output.write_text(json.dumps({"quantities": names, "ranked": RANKED, "ranks": content}))
        draw_figures(names, ranks, options.output)
    return 0 if all(n_tests * p > FAMILY_WISE for p, _ in worst.values()) else 1


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
