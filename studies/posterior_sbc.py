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
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy import stats

from fpcal_bayes.infer.identify import identify
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.posterior.target import PosteriorTarget
from fpcal_bayes.measure.protocol import paper_protocol, single_sweep
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cell import Cell, load_cell
from fpcal_bayes.report.tables import plain_table

SIGMA = 0.005
PROTOCOLS = ("paper", "paper-mid", "random")
#: Draws among which a truth is ranked; 200 ranks can be split into 20 bins and into the intervals below.
RANKED = 199
BINS = 20
COVERAGES = (0.5, 0.8, 0.95)
FAMILY_WISE = 0.01
#: Ends of a move of all six joints; no sweep moves more than one.
TASK = np.array([[60.0, 10.0, -60.0, 1.0, -1.0, 20.0], [-80.0, -12.0, 90.0, -2.0, 1.5, 60.0]])


@dataclass(frozen=True)
class Replicate:
    """Ranks of one truth, from 0 to `RANKED`, or None if the fit failed; and what the sampler says of itself."""

    ranks: list[int] | None
    failures: tuple[str, ...]
    charts: int


def plan(protocol: str, cell: Cell) -> Sweeps:
    """The sweeps of a protocol."""
    if protocol == "random":
        random = np.random.default_rng(20)
        parts = [_random_sweep(cell, random) for _ in range(69)]
        return join(parts)
    return paper_protocol(cell, midpoints=protocol == "paper-mid")


def _random_sweep(cell: Cell, random: np.random.Generator) -> Sweeps:
    """One joint moves, all stand anywhere within the paper's ranges."""
    reach = np.array([150.0, 20.0, 150.0, 3.0, 3.0, 90.0]) * cell.joint_scales
    joint = int(random.integers(6))
    start, end = reach[joint] * random.uniform(-1.0, 1.0, 2)
    return single_sweep(cell, joint + 1, start, end, pose=reach * random.uniform(-1.0, 1.0, 6))


def quantities(cell: Cell) -> list[str]:
    """Names of what is ranked."""
    return [*cell.free.names, "task", "log density"]


def run_replicate(number: int, *, protocol: str, seed: int, draws: int, steps: int | None = None) -> Replicate:
    """One truth; its random numbers depend on `seed`, the protocol and `number` alone.

    With `steps`, the walkers go so far and no further: the ranks are those of an exact sampler if the start is
    forgotten by then, whether or not the diagnostics have seen enough to say so.
    """
    cell = load_cell()
    sequence = np.random.SeedSequence([seed, PROTOCOLS.index(protocol), number])
    random = np.random.default_rng(sequence)
    values = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
    noise_seed, sampler_seed = random.integers(2**31, size=2).tolist()
    truth = Truth(cell.free, np.zeros(1), values[None])
    found = identify(cell, simulate(cell, truth, plan(protocol, cell), sigma=SIGMA, seed=noise_seed))
    charts = 1 + len(found.other_minima)
    if not found.converged:
        return Replicate(None, ("not identified",), charts)
    posterior = sample(found, draws=draws, seed=sampler_seed, max_steps=steps)

    problem = found.problem
    # Walkers do not interact; the middle and the end of each walk lie many autocorrelation times apart.
    steps = [posterior.points.shape[1] // 2, -1]
    chosen = posterior.points[:, steps].reshape(-1, problem.n_unknowns)[:RANKED]
    task = problem.model.rows(*(TASK[:, None] * cell.joint_scales))
    target = PosteriorTarget(problem)

    def ranked(unknowns: np.ndarray) -> np.ndarray:
        lengths = problem.model.predict(problem.values(unknowns), task)
        log_density = target.log_density(target.data_residuals(unknowns), unknowns)
        return np.column_stack([unknowns, lengths, log_density])

    ranks = (ranked(chosen) < ranked(problem.unknowns(values)[None])).sum(axis=0)
    return Replicate(ranks.tolist(), posterior.failures, charts)


def run_protocol(
    protocol: str, numbers: range, seed: int, draws: int, processes: int, steps: int | None = None
) -> list[Replicate]:
    """Replicates in the order of their numbers."""
    one = partial(run_replicate, protocol=protocol, seed=seed, draws=draws, steps=steps)
    if processes == 1:
        return list(map(one, numbers))
    with get_context("spawn").Pool(processes) as pool:
        return list(pool.imap(one, numbers))


@dataclass(frozen=True)
class Verdict:
    """Tests of one quantity: p-values of the ranks' uniformity, and of each interval's coverage."""

    name: str
    chi_square: float
    kolmogorov: float
    covered: list[float]
    coverage: list[float]


def judge(name: str, ranks: np.ndarray, random: np.random.Generator) -> Verdict:
    """Test the ranks (n_replicates,) of one quantity."""
    counts = np.bincount(ranks * BINS // (RANKED + 1), minlength=BINS)
    spread = (ranks + random.random(len(ranks))) / (RANKED + 1)
    covered, p_values = [], []
    for share in COVERAGES:
        tail = (RANKED + 1) * (1 - share) / 2
        inside = int(((ranks >= tail - 1e-9) & (ranks < RANKED + 1 - tail - 1e-9)).sum())
        covered.append(inside / len(ranks))
        p_values.append(float(stats.binomtest(inside, len(ranks), share).pvalue))
    return Verdict(
        name, float(stats.chisquare(counts).pvalue), float(stats.kstest(spread, "uniform").pvalue), covered, p_values
    )


def least_p(verdict: Verdict) -> float:
    """The smallest p-value of the five tests, corrected for their number."""
    return min(1.0, 5.0 * min(verdict.chi_square, verdict.kolmogorov, *verdict.coverage))


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
