"""One or two days of an unchanged cell, pooled: are parameters and task errors off by what is stated?

python studies/two_days.py [--setting axis midpoints short perpendicular once once-perpendicular] [--truths 100]

Truths are drawn from the prior. The second day comes in as `identify --prior` brings it; `once` is one day alone.
Printed: root mean square of errors over their stated standard deviation, least and largest of the parameters, and of
each task at its worst point by posterior draws; the share of task errors beyond the 97.5 % quantiles of these draws;
the sd of y_wf over its prior's; and the calibration curve of all tasks: P(> tolerance) as `task-error` states it, in
bins, beside how often the truth passed the tolerance, with the number of tasks and tolerances.
"""

import argparse

import numpy as np

from fpcal_bayes import InputError, Sweeps, identify, load_cell, paper_protocol, pool, simulate
from fpcal_bayes.infer import independent_draws, predict_from_draws
from fpcal_bayes.measure import Truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import TASKS, task_path

SETTINGS = ("axis", "midpoints", "short", "perpendicular", "once", "once-perpendicular")
#: Tolerances in um, and edges of the bins of stated probabilities.
TOLERANCES = np.geomspace(0.001, 4.0, 37)
BINS = np.array([0.002, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98])


def plans(cell: Cell, setting: str) -> tuple[Sweeps, ...]:
    """What is swept on each day; `short`: 12 sweeps on the second."""
    whole = paper_protocol(cell, midpoints=setting == "midpoints")
    if setting.startswith("once"):
        return (whole,)
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


def curve(stated: np.ndarray, passed: np.ndarray) -> str:
    """Mean stated probability and share that passed, bin by bin, and how many there are."""
    places, lines = np.digitize(stated, BINS), []
    for place in range(1, len(BINS)):
        rows = places == place
        lines.append(f"{stated[rows].mean():.3f} {passed[rows].mean():.3f} ({rows.sum()})" if rows.any() else "-")
    return "; ".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setting", nargs="*", default=SETTINGS, choices=SETTINGS)
    parser.add_argument("--truths", type=int, default=100)
    options = parser.parse_args()
    for setting in options.setting:
        opd = "perpendicular" if setting.endswith("perpendicular") else "axis"
        cell = load_cell(opd=opd, mechanics="none")
        model, names = CavityModel.of(cell), cell.free.names
        z, tasks, beyond, widths, stated, passed = [], {name: [] for name in TASKS}, [], [], [], []
        failed = bent = 0
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
            draws = independent_draws(found, seed=seed)
            if not len(draws):
                bent += 1
                continue
            estimate = found.estimate
            z.append((values - estimate.values) / estimate.sd)
            widths.append(estimate.sd[names.index("y_wf")] / cell.free.prior_sd[names.index("y_wf")])
            for name in TASKS:
                try:
                    task = task_path(cell, estimate.vector(), name, n_points=31)
                except InputError:
                    continue
                made = predict_from_draws(model, draws, estimate.values, task)
                worst = int(np.argmax(made.sd))
                errors = predict_from_draws(model, values[None], estimate.values, task)
                error = errors.errors[0, worst]
                tasks[name].append(error / made.sd[worst])
                low, high = np.quantile(made.errors[:, worst], [0.025, 0.975])
                beyond.append(not low <= error <= high)
                stated += [made.exceeds(tolerance) for tolerance in TOLERANCES]
                passed += [errors.exceeds(tolerance) for tolerance in TOLERANCES]
            if (seed + 1) % 20 and seed + 1 < options.truths:
                continue
            rms = np.sqrt(np.mean(np.square(z), axis=0))
            told = ", ".join(f"{name} {np.sqrt(np.mean(np.square(each))):.2f}" for name, each in tasks.items())
            print(
                f"{setting}, {len(z)} truths: rms z {rms.min():.2f} ({names[rms.argmin()]}) to {rms.max():.2f} "
                f"({names[rms.argmax()]}); {told}; outside 95 %: {100 * np.mean(beyond):.1f} %; sd of y_wf over its "
                f"prior's {np.median(widths):.3f}; {failed} not usable, {bent} without draws\n"
                f"  P(> tolerance) stated, found: {curve(np.array(stated), np.array(passed))}",
                flush=True,
            )


if __name__ == "__main__":
    main()
