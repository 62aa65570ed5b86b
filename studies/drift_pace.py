"""Drift sizes that are wrong: is the stated probability at the horizon the true one, and is the robot blamed?

python studies/drift_pace.py [--factors 3 1 0.333] [--campaigns 20]

Cells drift so many times as fast as stated, with six sweeps every eight hours. After 2, 4 and 8 sessions the horizon is
worked out for 50 nm on the circle at 10 %, and the truth drifts on to it: the share of campaigns beyond 50 nm there is
to be 10 %. Printed beside it: the scale that was learnt, and sessions at which the robot is said to have moved.
"""

import argparse

import numpy as np

from fpcal_bayes import Goal, load_cell, paper_protocol, paper_truth, simulate
from fpcal_bayes.decision import valid_until
from fpcal_bayes.infer import peak_to_peak, task_errors
from fpcal_bayes.measure import Sweeps, Truth, join
from fpcal_bayes.model import CavityModel
from fpcal_bayes.motion import task_path
from fpcal_bayes.tracking import DriftModel, track, with_learnt_scale

HOURS, COUNT = 8.0, 6


def plan(cell, random, name, time_h):
    """Six one-joint sweeps from random poses."""
    high = np.array([150.0, 150.0, 150.0, 3.0, 3.0, 90.0])
    start = random.uniform(-high, high, (COUNT, 6))
    end, rows = start.copy(), np.arange(COUNT)
    start[rows, rows % 6], end[rows, rows % 6] = -high[rows % 6], high[rows % 6]
    return Sweeps.of_um_deg(cell, start, end, session=name, time_h=time_h)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--factors", type=float, nargs="*", default=[3.0, 1.0, 1 / 3])
    parser.add_argument("--campaigns", type=int, default=20)
    parser.add_argument("--sessions", type=int, nargs="*", default=[2, 4, 8])
    options = parser.parse_args()
    cell = load_cell(mechanics="none")
    drift, model, goal = DriftModel.of(cell), CavityModel.of(cell), Goal(50)
    for factor in options.factors:
        beyond = {k: [] for k in options.sessions}
        scales, blamed = {k: [] for k in options.sessions}, {k: [] for k in options.sessions}
        for seed in range(options.campaigns):
            random = np.random.default_rng([seed, 12])
            last = max(options.sessions)
            day = factor * drift.walk * drift.scale
            steps = random.standard_normal((last + 1, len(day))) * day * np.sqrt(HOURS / 24.0)
            steps[0] = 0.0
            values = paper_truth(cell).at(0.0) + np.cumsum(steps, axis=0)
            times = HOURS * np.arange(last + 1)
            plans = [plan(cell, random, f"s{i}", times[i]) for i in range(1, last + 1)]
            sweeps = join([paper_protocol(cell), *plans])
            measured = simulate(cell, Truth(cell.free, times, values), sweeps, sigma_nm=5, seed=seed)
            for k in options.sessions:
                part = measured.take(measured.time_h <= times[k])
                found = with_learnt_scale(
                    track(cell, part), lambda sized, first, part=part: track(cell, part, drift=sized, known=first)
                )
                until = valid_until(found, goal)
                blamed[k].append(any(o.verdict == "intrinsics-moved" for o in found.outcomes))
                scales[k].append(found.drift.sizes[-1].walk / drift.sizes[-1].walk)
                later = values[k] + random.standard_normal((20, len(day))) * day * np.sqrt((until - times[k]) / 24.0)
                estimate = found.estimate()
                task = task_path(cell, estimate.vector(), "circle", n_points=37)
                beyond[k].append((peak_to_peak(task_errors(model, later, estimate.values, task)) > 0.05).mean())
        told = "; ".join(
            f"{k} sessions: {np.mean(beyond[k]):.3f} beyond, scale {np.median(scales[k]):.2f}, robot blamed in "
            f"{100 * np.mean(blamed[k]):.0f} %"
            for k in options.sessions
        )
        print(f"drift {factor:.2g} times as stated: {told}", flush=True)


if __name__ == "__main__":
    main()
