"""What do whole traces tell beyond end points and midpoints, and how few sweeps do they need?

The paper's 69 sweeps and 12 planned ones, truths drawn from the prior. End points and midpoints are readings of length,
with 5 nm each or with what a single sample of the simulated photodiode knows at half fringe height; whole traces are
its 2,000 samples of each sweep, with the scans that tell signs. Printed for each: standard deviations, and the mean
square of the standardised errors, which is one where they hold.

    python studies/whole_traces.py [--replicates 10]
"""

import argparse
import contextlib
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fpcal_bayes import InputError, plan
from fpcal_bayes.analysis import trace_rows
from fpcal_bayes.infer import identify, linear_task_sd, task_jacobian
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, Truth, paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Estimate, fringe
from fpcal_bayes.motion import task_path
from fpcal_bayes.simulator import record_sweeps, simulate_um

TASKS = ("circle", "line-x", "line-z", "tilt-x", "tilt-z", "spin")


def task_errors(estimate: Estimate, truth: Truth) -> list[tuple[float, float]]:
    """Of each task standard deviation at its worst point in nm, and the error there in units of it."""
    model, found = CavityModel.of(estimate.cell, estimate.parameters), []
    for name in TASKS:
        task = task_path(estimate.cell, estimate.vector(), name).driven()
        sds = linear_task_sd(task_jacobian(model, estimate.values, task), estimate.covariance)
        poses = model.pose_rows(np.vstack([task.start[None], task.q]))
        lengths = [model.predict(values, poses) for values in (estimate.values, truth.values[0])]
        errors = (lengths[1] - lengths[1][0]) - (lengths[0] - lengths[0][0])
        worst = int(np.argmax(sds))
        found.append((1e3 * float(sds[worst]), float(errors[1:][worst] / sds[worst])))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicates", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    cell = load_cell(mechanics="none")
    paper, ends, middle = paper_truth(cell), paper_protocol(cell), paper_protocol(cell, midpoints=True)
    planned, sds = plan(cell, 12, readings=0), np.array([p.prior_sd for p in paper.parameters])
    optics = cell.interferometer
    # One sample at half height, at either end.
    single = np.sqrt(2.0) * optics.noise * optics.wavelength / (4 * np.pi * optics.gain)
    single = float(single / fringe(optics, 920.0, 0.0)[1])

    def from_rows(protocol: Sweeps, sigma: float) -> Callable[[Truth, int], Estimate]:
        return lambda truth, seed: identify(cell, simulate_um(cell, truth, protocol, sigma=sigma, seed=seed)).estimate

    def from_traces(protocol: Sweeps) -> Callable[[Truth, int], Estimate]:
        def made(truth: Truth, seed: int) -> Estimate:
            index = record_sweeps(cell, truth, protocol, seed=seed)
            return identify(cell, trace_rows(cell, index)[0]).estimate

        return made

    cases = {
        "69, end points, 5 nm": from_rows(ends, 0.005),
        "69, midpoints, 5 nm": from_rows(middle, 0.005),
        f"69, midpoints, one sample ({1e3 * single:.1f} nm)": from_rows(middle, single),
        "69, whole traces": from_traces(ends),
        "12 planned, whole traces": from_traces(planned),
    }
    print(f"{'sweeps':38}{'z_et um':>9}{'z^2':>6}{'all z^2':>8}" + "".join(f"{name + ' nm':>17}" for name in TASKS))
    for name, make in cases.items():
        began, scores, zets, tasks = time.process_time(), [], [], []
        for seed in range(options.seed, options.seed + options.replicates):
            drawn = cell.free.nominal + sds * np.random.default_rng(seed).standard_normal(len(sds))
            truth = replace(paper, times_h=np.zeros(1), values=drawn[None])
            estimate = make(truth, seed)
            if not estimate.trust.usable:
                continue
            scores.append((estimate.values - drawn) / estimate.sd)
            zets.append(estimate.sd[cell.free.position("z_et")])
            # A truth of which some task leaves the joints' limits counts for its parameters only.
            with contextlib.suppress(InputError):
                tasks.append(task_errors(estimate, truth))
        squares, by_task = np.mean(np.square(scores), axis=0), np.array(tasks)
        print(
            f"{name:38}{np.median(zets):9.3f}{squares[cell.free.position('z_et')]:6.2f}{squares.mean():8.3f}"
            + "".join(
                f"{np.median(by_task[:, k, 0]):9.3f} ({np.mean(by_task[:, k, 1] ** 2):4.2f})  "
                for k in range(len(TASKS))
            )
            + f" {len(scores)} of {options.replicates} usable, {time.process_time() - began:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
