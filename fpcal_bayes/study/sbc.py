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
from fpcal_bayes.infer.posterior.draws import Posterior
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


def judge(name: str, ranks: NDArray[np.int64], random: np.random.Generator) -> dict[str, Any]:
    """Test the ranks (n_replicates,), 0 to `RANKED`, of a quantity, by their distribution and by central intervals."""
    counts = np.bincount(ranks * BINS // (RANKED + 1), minlength=BINS)
    spread = (ranks + random.random(len(ranks))) / (RANKED + 1)
    uniform = {
        "p_chi_square": float(stats.chisquare(counts).pvalue),
        "p_kolmogorov": float(stats.kstest(spread, "uniform").pvalue),
    }
    covered, p_values = {}, [*uniform.values()]
    for share in COVERAGES:
        tail = (RANKED + 1) * (1 - share) / 2
        inside = int(((ranks >= tail - 1e-9) & (ranks < RANKED + 1 - tail - 1e-9)).sum())
        covered[f"in_{100 * share:g}_percent"] = 100.0 * inside / len(ranks)
        p_values.append(float(stats.binomtest(inside, len(ranks), share).pvalue))
    # The smallest of the p-values is corrected for their number.
    return {"quantity": name} | uniform | covered | {"p_corrected": min(1.0, len(p_values) * min(p_values))}


PROTOCOLS = ("paper", "paper-mid", "random")
#: Ends of a move of all six joints, in um and deg; no sweep of a protocol moves more than one.
TASK = np.array([[60.0, 10.0, -60.0, 1.0, -1.0, 20.0], [-80.0, -12.0, 90.0, -2.0, 1.5, 60.0]])


def sbc_plan(protocol: str, cell: Cell) -> Sweeps:
    """The sweeps of one of `PROTOCOLS`."""
    if protocol == "random":
        random = np.random.default_rng(20)
        return join([_random_sweep(cell, random) for _ in range(69)])
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


@dataclass(frozen=True, kw_only=True)
class PosteriorRanks(Study):
    """Simulation-based calibration."""

    name: ClassVar[str] = "sbc"

    plan: Sweeps  # sweeps of each calibration
    sigma: float = 0.005  # standard deviation of each change of cavity length, in um
    draws: int = 400  # effective draws of each posterior
    steps: int | None = None  # of each walker at most, or None for as many as it takes

    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"identified": (), "sampled": (), "charts": (), "ranks": (len(quantities(self.cell)),)}

    def settings(self) -> dict[str, Any]:
        own = {"sigma_um": self.sigma, "draws": self.draws, "steps": self.steps}
        return {"sweeps_sha256": sweeps_sha256(self.plan)} | own

    def replicate(self, number: int) -> dict[str, Floats]:
        # With `steps` the walkers go so far and no further: the ranks are those of an exact sampler if the start is.
        cell, random = self.cell, self.random(number)
        truth = drawn_truth(cell, random)
        noise_seed, sampler_seed = random.integers(2**31, size=2).tolist()
        found = identify(cell, simulate_um(cell, truth, self.plan, sigma=self.sigma, seed=noise_seed))
        flags = {"identified": float(found.converged), "sampled": 0.0, "charts": 1.0 + len(found.other_minima)}
        ranks = np.full(len(quantities(cell)), np.nan)
        if found.converged:
            posterior = sample(found, draws=self.draws, seed=sampler_seed, max_steps=self.steps)
            flags["sampled"] = float(not posterior.failures)
            ranks = _ranks(posterior, truth.values[0])
        return {name: np.array(flag) for name, flag in flags.items()} | {"ranks": ranks}

    def summary(self, results: Results) -> Summary:
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
        rows = [judge(name, ranks[:, i], random) for i, name in enumerate(names)]
        worst = min(rows, key=lambda row: row["p_corrected"])
        corrected = min(1.0, len(names) * worst["p_corrected"])
        good = corrected > FAMILY_WISE
        if not good:
            warnings.append(
                f"not calibrated: {worst['quantity']}, p = {corrected:.2g} over all {len(names)} quantities"
            )
        sentences = [
            f"{len(ranks)} of {len(kept)} truths ranked, {several} with several charts",
            f"{'calibrated' if good else 'NOT calibrated'}: worst {worst['quantity']}, p = {corrected:.3g} over all "
            f"{len(names)} quantities (family-wise level {FAMILY_WISE})",
        ]
        return Summary("ranks of the truths among posterior draws", rows, sentences, warnings)


def _ranks(posterior: Posterior, truth: Floats) -> Floats:
    """Ranks of a truth (n_free,) among `RANKED` draws, in the order of `quantities`."""
    problem = posterior.identification.problem
    # Walkers do not interact; the middle and the end of each walk lie many autocorrelation times apart.
    chosen_steps = [posterior.points.shape[1] // 2, -1]
    chosen = posterior.points[:, chosen_steps].reshape(-1, problem.n_unknowns)[:RANKED]
    task = problem.model.rows(*(TASK[:, None] * problem.model.cell.joint_scales))
    target = PosteriorTarget(problem)

    def ranked(unknowns: Floats) -> Floats:
        lengths = problem.model.predict(problem.values(unknowns), task)
        return np.column_stack([unknowns, lengths, target.log_density(target.data_residuals(unknowns), unknowns)])

    return np.asarray((ranked(chosen) < ranked(problem.unknowns(truth)[None])).sum(axis=0).astype(float))
