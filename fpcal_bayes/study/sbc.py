"""Is the posterior right? Simulation-based calibration (Talts et al. 2018) of all parameters and of a task.

A truth is drawn from the prior, sweeps are simulated from it, identified and sampled, and the truth is ranked among
the draws: if the sampler is right, every rank is equally likely. Ranked are the parameters, the change of cavity
length along a path that no sweep contains, and the log density itself, which shows a mode that is missed
(Modrak et al. 2023).
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.posterior.target import PosteriorTarget
from fpcal_bayes.measure.protocol import paper_protocol, single_sweep
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.study.base import Results, Study, Summary, drawn_truth, sweeps_sha256

#: Draws among which a truth is ranked; 200 ranks can be split into 20 bins and into the intervals below.
RANKED = 199
BINS = 20
COVERAGES = (0.5, 0.8, 0.95)
FAMILY_WISE = 0.01


@dataclass(frozen=True)
class RankVerdict:
    """Tests of one quantity: p-values of the ranks' uniformity, and of each interval's coverage."""

    name: str
    # chi_square, kolmogorov: p-values of the ranks in bins, and of their distribution
    chi_square: float
    kolmogorov: float
    # covered, coverage: share of the ranks in each central interval of `COVERAGES`, and its p-value
    covered: list[float]
    coverage: list[float]


def judge(name: str, ranks: NDArray[np.int64], random: np.random.Generator) -> RankVerdict:
    """Test the ranks (n_replicates,), 0 to `RANKED`, of one quantity."""
    counts = np.bincount(ranks * BINS // (RANKED + 1), minlength=BINS)
    spread = (ranks + random.random(len(ranks))) / (RANKED + 1)
    covered, p_values = [], []
    for share in COVERAGES:
        tail = (RANKED + 1) * (1 - share) / 2
        inside = int(((ranks >= tail - 1e-9) & (ranks < RANKED + 1 - tail - 1e-9)).sum())
        covered.append(inside / len(ranks))
        p_values.append(float(stats.binomtest(inside, len(ranks), share).pvalue))
    return RankVerdict(
        name, float(stats.chisquare(counts).pvalue), float(stats.kstest(spread, "uniform").pvalue), covered, p_values
    )


def least_p(verdict: RankVerdict) -> float:
    """The smallest p-value of the five tests, corrected for their number."""
    return min(1.0, 5.0 * min(verdict.chi_square, verdict.kolmogorov, *verdict.coverage))


PROTOCOLS = ("paper", "paper-mid", "random")
#: Ends of a move of all six joints, in um and deg; no sweep of a protocol moves more than one.
TASK = np.array([[60.0, 10.0, -60.0, 1.0, -1.0, 20.0], [-80.0, -12.0, 90.0, -2.0, 1.5, 60.0]])


@dataclass(frozen=True)
class Replicate:
    """Ranks of one truth, from 0 to `RANKED`, or None if the fit failed; and what the sampler says of itself."""

    ranks: list[int] | None
    failures: tuple[str, ...]
    charts: int


def sbc_plan(protocol: str, cell: Cell) -> Sweeps:
    """The sweeps of one of `PROTOCOLS`."""
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


def ranks_of(
    cell: Cell, plan: Sweeps, random: np.random.Generator, *, sigma: float, draws: int, steps: int | None = None
) -> Replicate:
    """Draw one truth and rank it.

    `sigma` is the standard deviation of each change of cavity length in um; `draws` the effective draws of the
    posterior, at least `RANKED`. With `steps` the walkers go so far and no further: the ranks are those of an exact
    sampler if the start is.
    """
    truth = drawn_truth(cell, random)
    values = truth.values[0]
    noise_seed, sampler_seed = random.integers(2**31, size=2).tolist()
    found = identify(cell, simulate_um(cell, truth, plan, sigma=sigma, seed=noise_seed))
    charts = 1 + len(found.other_minima)
    if not found.converged:
        return Replicate(None, ("not identified",), charts)
    posterior = sample(found, draws=draws, seed=sampler_seed, max_steps=steps)

    problem = found.problem
    # Walkers do not interact; the middle and the end of each walk lie many autocorrelation times apart.
    chosen_steps = [posterior.points.shape[1] // 2, -1]
    chosen = posterior.points[:, chosen_steps].reshape(-1, problem.n_unknowns)[:RANKED]
    task = problem.model.rows(*(TASK[:, None] * cell.joint_scales))
    target = PosteriorTarget(problem)

    def ranked(unknowns: Floats) -> Floats:
        lengths = problem.model.predict(problem.values(unknowns), task)
        log_density = target.log_density(target.data_residuals(unknowns), unknowns)
        return np.column_stack([unknowns, lengths, log_density])

    ranks = (ranked(chosen) < ranked(problem.unknowns(values)[None])).sum(axis=0)
    return Replicate(ranks.tolist(), posterior.failures, charts)


@dataclass(frozen=True, kw_only=True)
class PosteriorRanks(Study):
    """Simulation-based calibration."""

    name: ClassVar[str] = "sbc"

    plan: Sweeps  # sweeps of each calibration
    sigma: float = 0.005  # standard deviation of each change of cavity length, in um
    draws: int = 400  # effective draws of each posterior
    steps: int | None = None  # of each walker at most, or None for as many as it takes

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the numbers that one replicate gives."""
        return {"identified": (), "sampled": (), "charts": (), "ranks": (len(quantities(self.cell)),)}

    def settings(self) -> dict[str, Any]:
        """The sweeps, their noise, and the length of each walk."""
        own = {"sigma_um": self.sigma, "draws": self.draws, "steps": self.steps}
        return {"sweeps_sha256": sweeps_sha256(self.plan)} | own

    def replicate(self, number: int) -> dict[str, Floats]:
        """Ranks of one truth, NaN if it was not identified; whether its draws converged (1 or 0)."""
        found = ranks_of(
            self.cell, self.plan, self.random(number), sigma=self.sigma, draws=self.draws, steps=self.steps
        )
        ranks = np.full(len(quantities(self.cell)), np.nan) if found.ranks is None else np.array(found.ranks, float)
        flags = {"identified": found.ranks is not None, "sampled": not found.failures, "charts": found.charts}
        return {name: np.array(float(flag)) for name, flag in flags.items()} | {"ranks": ranks}

    def summary(self, results: Results) -> Summary:
        """Tests of each quantity's ranks."""
        kept = results["identified"] > 0
        ranks = results["ranks"][kept].astype(np.int64)
        names = quantities(self.cell)
        unsampled = int((kept & (results["sampled"] == 0)).sum())
        several = int((results["charts"] > 1).sum())
        warnings = []
        if unsampled and self.steps is None:
            warnings.append(f"{unsampled} posteriors did not converge; their ranks count all the same")
        if len(ranks) < len(kept):
            warnings.append(f"{len(kept) - len(ranks)} truths were not identified and are left out")
        if not len(ranks):
            return Summary("ranks", [], [], warnings)
        random = np.random.default_rng(self.seed)
        verdicts = [judge(name, ranks[:, i], random) for i, name in enumerate(names)]
        rows: list[dict[str, str | int | float]] = [
            {
                "quantity": v.name,
                "p_chi_square": v.chi_square,
                "p_kolmogorov": v.kolmogorov,
                **{f"in_{100 * c:g}_percent": 100.0 * share for c, share in zip(COVERAGES, v.covered, strict=True)},
                "p_corrected": least_p(v),
            }
            for v in verdicts
        ]
        worst = min(verdicts, key=least_p)
        corrected = min(1.0, len(names) * least_p(worst))
        good = corrected > FAMILY_WISE
        if not good:
            warnings.append(f"not calibrated: {worst.name}, p = {corrected:.2g} over all {len(names)} quantities")
        sentences = [
            f"{len(ranks)} of {len(kept)} truths ranked, {several} with several charts",
            f"{'calibrated' if good else 'NOT calibrated'}: worst {worst.name}, p = {corrected:.3g} over all "
            f"{len(names)} quantities (family-wise level {FAMILY_WISE})",
        ]
        return Summary("ranks of the truths among posterior draws", rows, sentences, warnings)
