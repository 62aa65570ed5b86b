"""Two days of an unchanged cell, pooled: are parameters and task errors off by what is stated?

python studies/two_days.py [--setting axis midpoints short perpendicular] [--truths 100]

Truths are drawn from the prior. The second day comes in as `identify --prior` brings it. Printed: root mean square of
errors over their stated standard deviation, least and largest of the parameters, and of each task at its worst point by
posterior draws; the share of task errors beyond the 97.5 % quantiles of these draws; and the sd of y_wf
over its prior's.
"""

import argparse

import numpy as np

from fpcal_bayes import InputError, Sweeps, identify, load_cell, paper_protocol, pool, simulate
from fpcal_bayes.infer import independent_draws, predict_from_draws
from fpcal_bayes.measure import Truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import TASKS, task_path

SETTINGS = ("axis", "midpoints", "short", "perpendicular")


def plans(cell: Cell, setting: str) -> tuple[Sweeps, Sweeps]:
    """What is swept on either day; `short`: 12 sweeps on the second."""
    whole = paper_protocol(cell, midpoints=setting == "midpoints")
    return whole, whole.take(np.arange(len(whole)) % 6 == 0) if setting == "short" else whole


def reachable(cell: Cell, random: np.random.Generator) -> np.ndarray:
    """A geometry from the prior with which every task can be driven."""
    while True:
        values = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
        try:
            task_path(cell, CavityModel.of(cell).vector(values), "spin", n_points=3)
        except InputError:
            continue
        return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setting", nargs="*", default=SETTINGS, choices=SETTINGS)
    parser.add_argument("--truths", type=int, default=100)
    options = parser.parse_args()
    for setting in options.setting:
        opd = "perpendicular" if setting == "perpendicular" else "axis"
        cell = load_cell(opd=opd, mechanics="none")
        model, names = CavityModel.of(cell), cell.free.names
        z, tasks, beyond, widths = [], {name: [] for name in TASKS}, [], []
        failed = 0
        for seed in range(options.truths):
            values = reachable(cell, np.random.default_rng([seed, 5]))
            truth = Truth(cell.free, np.zeros(1), values[None])
            days = [
                simulate(cell, truth, plan, sigma_nm=5, seed=2 * seed + i)
                for i, plan in enumerate(plans(cell, setting))
            ]
            found = identify(cell, pool(days), seed=seed)
            if not found.estimate.trust.usable:
                failed += 1
                continue
            estimate = found.estimate
            z.append((values - estimate.values) / estimate.sd)
            widths.append(estimate.sd[names.index("y_wf")] / cell.free.prior_sd[names.index("y_wf")])
            draws = independent_draws(found, seed=seed)
            for name in TASKS:
                try:
                    task = task_path(cell, estimate.vector(), name, n_points=31)
                except InputError:
                    continue
                made = predict_from_draws(model, draws, estimate.values, task)
                worst = int(np.argmax(made.sd))
                error = predict_from_draws(model, values[None], estimate.values, task).errors[0, worst]
                tasks[name].append(error / made.sd[worst])
                low, high = np.quantile(made.errors[:, worst], [0.025, 0.975])
                beyond.append(not low <= error <= high)
        rms = np.sqrt(np.mean(np.square(z), axis=0))
        told = ", ".join(f"{name} {np.sqrt(np.mean(np.square(found))):.2f}" for name, found in tasks.items())
        print(
            f"{setting}: rms z {rms.min():.2f} ({names[rms.argmin()]}) to {rms.max():.2f} ({names[rms.argmax()]}); "
            f"{told}; "
            f"outside 95 %: {100 * np.mean(beyond):.1f} %; sd of y_wf over its prior's {np.median(widths):.3f}; "
            f"{failed} not usable",
            flush=True,
        )


if __name__ == "__main__":
    main()
