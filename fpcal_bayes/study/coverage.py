"""Coverage: how often the truth lies where an estimate says.

Each replicate draws a cell from the prior, measures sweeps on it, identifies, and lets the controller make each task's
joint path with the estimate. The true peak to peak of the task error, in each degree of freedom that the task has an
error in, is compared with the predicted 50, 80 and 95 % bands: of draws of the posterior, as an estimate file has them,
and to first order from its covariance. Every task is taken over its whole path, beyond joint limits too, so that all
calibrations are judged on the same task.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import stats

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import covariance_root, quantile_band
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.posterior.draws import independent_draws
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors, task_jacobian
from fpcal_bayes.infer.tasks.pose import FREEDOMS, pose_changes, pose_jacobian
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import TASKS, Task, task_path
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.study.base import Results, Study, Summary, drawn_truth, sweeps_sha256

METHODS = ("draws", "covariance")
SHARES = (0.5, 0.8, 0.95)
#: Draws of the linear prediction, and points of each path.
_LINEAR_DRAWS, _POINTS = 2000, 31
#: What is judged: degrees of freedom of each task, in um and rad; a band narrower than this is rounding.
QUANTITIES = tuple((task, freedom) for task in TASKS for freedom in ("beam", *FREEDOMS))
_LEAST_WIDTH = 1e-8
#: Coverage is called wrong below this probability of one as far off, over all tests of the study.
FAMILY_WISE = 0.01


@dataclass(frozen=True, kw_only=True)
class Coverage(Study):
    """The study of coverage."""

    name: ClassVar[str] = "coverage"

    plan: Sweeps  # sweeps of each calibration
    sigma: float = 0.005  # standard deviation of each change of cavity length, in um

    def shapes(self) -> dict[str, tuple[int, ...]]:
        n, edges = len(QUANTITIES), (len(QUANTITIES), len(SHARES), 2)
        fit = dict.fromkeys(("converged", "chi2_data", "p_value", "sum_of_squares"), ())
        return fit | {"true": (n,), "rank": (n,)} | dict.fromkeys(METHODS, edges)

    def settings(self) -> dict[str, Any]:
        return {"sweeps_sha256": sweeps_sha256(self.plan), "sigma_um": self.sigma}

    def replicate(self, number: int) -> dict[str, Floats]:
        """Fit, true peak to peak of each quantity, its rank among the draws (0 to 1), and the edges of the bands."""
        random = self.random(number)
        truth = drawn_truth(self.cell, random)
        measured = simulate_um(self.cell, truth, self.plan, sigma=self.sigma, seed=int(random.integers(2**31)))
        result = {name: np.full(shape, np.nan) for name, shape in self.shapes().items()}
        found = identify(self.cell, measured)
        result["converged"] = np.array(float(found.converged))
        if not found.converged:
            return result
        result["chi2_data"] = np.array(found.fit.chi2_data)
        result["p_value"] = np.array(found.fit.p_value)
        result["sum_of_squares"] = np.array(found.solution.sum_of_squares)
        self._judge_tasks(result, found, truth.values[0])
        return result

    def _judge_tasks(self, result: dict[str, Floats], found: Identification, truth: Floats) -> None:
        estimate, model = found.estimate, CavityModel.of(self.cell)
        draws = independent_draws(found)
        # Draws of the linear error; the covariance may be singular along gauges.
        root = covariance_root(estimate.covariance, estimate.parameters.prior_sd)
        changes = np.random.default_rng(1).standard_normal((_LINEAR_DRAWS, len(root))) @ root.T
        # The truth first, then the draws.
        each, n = np.vstack([truth, draws]), 1 + len(FREEDOMS)
        for i, name in enumerate(TASKS):
            task = self._path(estimate.vector(), name)
            if task is None:
                continue
            poses = pose_changes(model, each, estimate.values, task)[1]
            lengths = task_errors(model, each, estimate.values, task)
            widths = peak_to_peak(np.vstack([lengths[None], np.moveaxis(poses, -1, 0)]))
            slopes = pose_jacobian(model, estimate.values, task)[1]
            jacobian = task_jacobian(model, estimate.values, task)
            linear = np.array([changes @ jacobian.T, *np.moveaxis(np.tensordot(changes, slopes, axes=1), -1, 0)])
            bands = np.moveaxis(quantile_band(peak_to_peak(linear), SHARES, axis=1), -1, 0)
            for k, part in enumerate(range(n * i, n * (i + 1))):
                if bands[k].max() < _LEAST_WIDTH:
                    continue
                result["true"][part], result["covariance"][part] = widths[k, 0], bands[k]
                if len(draws):
                    result["draws"][part] = quantile_band(widths[k, 1:], SHARES)
                    result["rank"][part] = (widths[k, 1:] < widths[k, 0]).mean()

    def _path(self, vector: Floats, name: str) -> Task | None:
        """The path of a task, or None if by its estimate this robot cannot take the aligned pose."""
        try:
            task = task_path(self.cell, vector, name, n_points=_POINTS)
        except InputError:
            return None
        return task if task.finite.all() else None

    def summary(self, results: Results) -> Summary:
        return summarise(results)


def summarise(results: Results) -> Summary:
    """Share of the truths in each band, with a test against what is stated."""
    kept = results["converged"] > 0
    rows: list[dict[str, str | int | float]] = []
    least, tests = 1.0, 0
    for i, (task, freedom) in enumerate(QUANTITIES):
        if not np.isfinite(results["true"][kept, i]).any():
            continue
        tests += len(SHARES)
        for method in METHODS:
            edges, true = results[method][kept, i], results["true"][kept, i]
            seen = np.isfinite(edges).all(axis=(1, 2)) & np.isfinite(true)
            row: dict[str, str | int | float] = {"task": task, "freedom": freedom, "method": method}
            row["n"] = int(seen.sum())
            for share, (low, high) in zip(SHARES, edges[seen].transpose(1, 2, 0), strict=True):
                inside = int(((low <= true[seen]) & (true[seen] <= high)).sum())
                row[f"in_{100 * share:g}_percent"] = 100.0 * inside / seen.sum() if seen.any() else 0.0
                p = float(stats.binomtest(inside, int(seen.sum()), share).pvalue) if seen.any() else 1.0
                row[f"p_{100 * share:g}"] = p
                if method == "draws":
                    least = min(least, p)
            rows.append(row)
    corrected = min(1.0, tests * least)
    n = int(kept.sum())
    sentences = [f"{n} of {len(kept)} calibrations converged"]
    warnings = []
    if n:
        uniform = float(stats.kstest(results["p_value"][kept], "uniform").pvalue)
        sentences.append(f"p-values of the data's chi-square are uniform with p = {uniform:.3g} (Kolmogorov)")
        sentences.append(f"bands of draws: p = {corrected:.3g} over {tests} tests")
    if corrected < FAMILY_WISE:
        warnings.append(f"the bands of draws do not hold what they state (p = {corrected:.2g} over {tests} tests)")
    if n < len(kept):
        warnings.append(f"{len(kept) - n} calibrations did not converge and are left out")
    return Summary("truths in the predicted bands of the peak to peak, in %", rows, sentences, warnings)
