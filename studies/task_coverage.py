"""Is the true peak to peak of a task where its prediction says?

Each replicate draws a truth, measures the paper's sweeps on it, identifies, lets the controller make each task's joint
path with the estimate, and compares the true peak to peak with the predicted 95 % band. Predictions:

- linear: propagated to first order from the Laplace covariance, as `fpcal task-error ESTIMATE.json` does;
- posterior: draws of the posterior (randomise-then-optimise, weighted), as `fpcal task-error POSTERIOR.nc` does;
- nonlinear: Gaussian draws of the Laplace covariance through the full model, to show why that is not done.

    python studies/task_coverage.py --replicates 1000 [--protocol paper|paper-mid] [--truth prior|paper]
"""

import argparse
import time

import numpy as np

from fpcal_bayes.control.tasks import TASKS, task_path
from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.identify import Identification, identify
from fpcal_bayes.infer.posterior.chart import Chart
from fpcal_bayes.infer.posterior.target import PosteriorTarget
from fpcal_bayes.infer.task_error import peak_to_peak, task_errors
from fpcal_bayes.infer.task_prediction import predict_from_covariance
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell, load_cell

METHODS = ("linear", "posterior", "nonlinear")
Bands = dict[str, tuple[float, float]]


def posterior_draws(found: Identification, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the posterior around its maximum from standard normal ones (n_draws, n), and their weights."""
    chart = Chart(PosteriorTarget(found.problem), found.solution.unknowns)
    solved = chart.solve(normal)
    inside = solved.inside
    log_weight = solved.log_density[inside] - solved.log_proposal[inside]
    return found.problem.values(solved.points[inside]), np.exp(log_weight - log_weight.max())


def quantiles(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """The 2.5 % and 97.5 % quantiles of weighted values."""
    order = np.argsort(values)
    share = (np.cumsum(weights[order]) - weights[order] / 2) / weights.sum()
    low, high = np.interp([0.025, 0.975], share, values[order])
    return float(low), float(high)


def replicate(
    cell: Cell, plan: Sweeps, truth: Truth, methods: list[str], n_draws: int, random: np.random.Generator
) -> dict[str, tuple[float, Bands]] | None:
    """True peak to peak and the predicted bands of each task that can be driven; None if the fit did not converge."""
    model, values = CavityModel.of(cell), truth.values[0]
    found = identify(cell, simulate(cell, truth, plan, sigma=0.005, seed=int(random.integers(2**31))))
    if not found.converged:
        return None
    estimate = found.estimate
    draws = {}
    if "posterior" in methods:
        draws["posterior"] = posterior_draws(found, random.standard_normal((n_draws, len(values))))
    if "nonlinear" in methods:
        spread = random.multivariate_normal(estimate.values, estimate.covariance, size=n_draws, method="eigh")
        draws["nonlinear"] = spread, np.ones(len(spread))
    result = {}
    for name in TASKS:
        try:
            task = task_path(cell, estimate.vector(), name, n_points=31)
        except InputError:
            # The joint limits do not let this robot take the aligned pose.
            continue
        bands: Bands = {}
        if "linear" in methods:
            low, high = predict_from_covariance(estimate, task, draws=2000, seed=1).peak_to_peak_band()
            bands["linear"] = float(low), float(high)
        for method, (truths, weights) in draws.items():
            bands[method] = quantiles(peak_to_peak(task_errors(model, truths, estimate.values, task)), weights)
        result[name] = float(peak_to_peak(task_errors(model, values, estimate.values, task))[0]), bands
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicates", type=int, default=1000)
    parser.add_argument("--protocol", choices=("paper", "paper-mid"), default="paper")
    parser.add_argument("--truth", choices=("prior", "paper"), default="prior")
    parser.add_argument("--opd", choices=("axis", "perpendicular"), default="axis")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["linear", "posterior"])
    parser.add_argument("--draws", type=int, default=300, help="of posterior and nonlinear")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    began = time.perf_counter()
    cell = load_cell(opd=options.opd)
    plan = paper_protocol(cell, midpoints=options.protocol == "paper-mid")
    random = np.random.default_rng(options.seed)
    results, unused = [], 0
    for _ in range(options.replicates):
        values = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
        truth = paper_truth(cell) if options.truth == "paper" else Truth(cell.free, np.zeros(1), values[None])
        result = replicate(cell, plan, truth, options.methods, options.draws, random)
        unused += result is None
        results.append(result or {})

    print(f"{options.truth} truth, {options.protocol}, opd {options.opd}: {options.replicates - unused} calibrations")
    print(f"{'task':10}" + "".join(f"{method + ' %':>14}" for method in options.methods) + f"{'driven':>10}")
    for name in TASKS:
        seen = [result[name] for result in results if name in result]
        shares = [np.mean([bands[m][0] <= true <= bands[m][1] for true, bands in seen]) for m in options.methods]
        print(f"{name:10}" + "".join(f"{100 * share:14.1f}" for share in shares) + f"{len(seen):10}")
    print(f"{unused} without convergence left out, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
