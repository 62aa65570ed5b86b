"""Is the true peak to peak of a task where its prediction says?

Each replicate draws a truth, measures the paper's sweeps on it, identifies, lets the controller make each task's joint
path with the estimate, and compares the true peak to peak with the predicted 95 % band. Every task is taken over its
whole path, beyond joint limits too, so that all calibrations are judged on the same task. Predictions:

- draws: of the posterior around all of its minima, as an estimate of `fpcal identify` holds them and
  `fpcal task-error ESTIMATE.json` uses them;
- linear: to first order from the Laplace covariance, for estimates without draws;
- nonlinear: Gaussian draws of the Laplace covariance through the full model, to show why that is not done.

    python studies/task_coverage.py --replicates 1000 [--protocol paper|paper-mid] [--truth prior|paper]
"""

import argparse
import time

import numpy as np

from fpcal_bayes.control.tasks import TASKS, task_path
from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.estimate_draws import N_DRAWS, independent_draws
from fpcal_bayes.infer.identify import identify
from fpcal_bayes.infer.task_error import peak_to_peak, task_errors
from fpcal_bayes.infer.task_prediction import predict_from_covariance
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rig import simulate
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell, load_cell

METHODS = ("draws", "linear", "nonlinear")
EDGES = (0.025, 0.975)
Band = tuple[float, float]


def replicate(
    cell: Cell, plan: Sweeps, truth: Truth, methods: list[str], random: np.random.Generator
) -> dict[str, tuple[float, dict[str, Band]]] | None:
    """True peak to peak and the predicted bands of each task that can be driven; None if the fit did not converge."""
    model, values = CavityModel.of(cell), truth.values[0]
    found = identify(cell, simulate(cell, truth, plan, sigma=0.005, seed=int(random.integers(2**31))))
    if not found.converged:
        return None
    estimate = found.estimate
    draws = {}
    if "draws" in methods:
        draws["draws"] = independent_draws(found)
    if "nonlinear" in methods:
        draws["nonlinear"] = random.multivariate_normal(
            estimate.values, estimate.covariance, size=N_DRAWS, method="eigh"
        )
    result = {}
    for name in TASKS:
        try:
            task = task_path(cell, estimate.vector(), name, n_points=31)
        except InputError:
            # By its estimate, this robot's joint limits do not let it take the aligned pose.
            continue
        bands = {}
        if "linear" in methods:
            low, high = predict_from_covariance(estimate, task, draws=2000, seed=1).peak_to_peak_band()
            bands["linear"] = float(low), float(high)
        for method, truths in draws.items():
            low, high = np.quantile(peak_to_peak(task_errors(model, truths, estimate.values, task)), EDGES)
            bands[method] = float(low), float(high)
        result[name] = float(peak_to_peak(task_errors(model, values, estimate.values, task))[0]), bands
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicates", type=int, default=1000)
    parser.add_argument("--protocol", choices=("paper", "paper-mid"), default="paper")
    parser.add_argument("--truth", choices=("prior", "paper"), default="prior")
    parser.add_argument("--opd", choices=("axis", "perpendicular"), default="axis")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["draws", "linear"])
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
        result = replicate(cell, plan, truth, options.methods, random)
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
