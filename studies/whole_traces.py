"""What do whole traces tell beyond end points and midpoints, on the paper's 69 sweeps?

Two noises: 5 nm of independent noise on the cavity length at each of 40 points of a sweep (vibration), end points and
midpoints being single readings with the same noise; and the simulated photodiode's, 2,000 samples a sweep, end points
being single samples. Whole traces are fitted as irradiance, phase and levels of each trace unknown. Beside them the
bound of linear theory for 40 readings of length, with the length at the start of a sweep unknown and known: a trace
that goes on for some seconds at rest before and after the motion comes near the second.

    python studies/whole_traces.py [--replicates 10] [-o FOLDER]
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.infer import fit_traces, identify, linear_task_sd, task_jacobian
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Cell, Estimate, fringe
from fpcal_bayes.motion import task_path
from fpcal_bayes.simulator import RecorderSettings, record_sweeps, simulate_um

VIBRATION, POINTS = 0.005, 40
TASKS = ("circle", "tilt-x", "tilt-z", "spin")


def bound(cell: Cell, known_start: bool) -> float:
    """Standard deviation of z_et from 40 readings of length a sweep, to first order at the truth."""
    model, plan, values = CavityModel.of(cell), paper_protocol(cell), paper_truth(cell).values[0]
    share = np.linspace(0.0, 1.0, POINTS + 1)[:, None]
    q = plan.q_start[:, None] + (plan.q_end - plan.q_start)[:, None] * share
    jacobian = model.predict_with_jacobian(values, model.pose_rows(q.reshape(-1, 6)))[1].reshape(
        len(plan), len(share), -1
    )
    jacobian -= jacobian[:, :1] if known_start else jacobian.mean(axis=1, keepdims=True)
    scaled = jacobian.reshape(-1, len(values)) * model.free.prior_sd / VIBRATION
    at = model.free.position("z_et")
    covariance = np.linalg.inv(scaled.T @ scaled + np.eye(len(values)))
    return float(np.sqrt(covariance[at, at]) * model.free.prior_sd[at])


def task_sds(estimate: Estimate) -> list[float]:
    """Standard deviation of the task error at the worst point of each task, in nm."""
    model = CavityModel.of(estimate.cell, estimate.parameters)
    found = []
    for name in TASKS:
        task = task_path(estimate.cell, estimate.vector(), name).driven()
        found.append(
            1e3 * float(linear_task_sd(task_jacobian(model, estimate.values, task), estimate.covariance).max())
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicates", type=int, default=10)
    parser.add_argument("-o", dest="output", type=Path, default=Path(__file__).parent / "output")
    options = parser.parse_args()

    cell = load_cell(mechanics="none")
    truth, plan, middle = paper_truth(cell), paper_protocol(cell), paper_protocol(cell, midpoints=True)
    at = cell.free.position("z_et")
    # Vibration alone: a photodiode whose noise is small beside it.
    quiet = replace(cell, optics=replace(cell.interferometer, noise=5e-4))
    optics = cell.interferometer
    # One sample at half height, at either end.
    single = (
        np.sqrt(2.0)
        * optics.noise
        * optics.wavelength
        / (4 * np.pi * optics.gain * float(fringe(optics, 920.0, 0.0)[1]))
    )
    resting = RecorderSettings(rate_hz=POINTS / 10.0, length_noise=VIBRATION, rest_s=5.0)
    vibrating = RecorderSettings(rate_hz=POINTS / 10.0, length_noise=VIBRATION)

    def from_sweeps(protocol, sigma: float, seed: int) -> Estimate:  # type: ignore[no-untyped-def]
        return identify(cell, simulate_um(cell, truth, protocol, sigma=sigma, seed=seed)).estimate

    def from_traces(rig: Cell, settings: RecorderSettings, noise: float, seed: int) -> Estimate:
        start = from_sweeps(plan, VIBRATION, seed)
        index = record_sweeps(rig, truth, plan, settings, seed=seed, scans=False)
        fit = fit_traces(rig, index, start, length_noise=noise)
        assert fit.converged, fit.warnings
        return fit.estimate

    cases = {
        "end points, 5 nm": lambda seed: from_sweeps(plan, np.sqrt(2.0) * VIBRATION, seed),
        "midpoints, 5 nm": lambda seed: from_sweeps(middle, np.sqrt(2.0) * VIBRATION, seed),
        "whole traces, 40 points of 5 nm": lambda seed: from_traces(quiet, vibrating, VIBRATION, seed),
        "the same, 5 s at rest at either end": lambda seed: from_traces(quiet, resting, VIBRATION, seed),
        f"end points, photodiode ({1e3 * single:.1f} nm)": lambda seed: from_sweeps(plan, float(single), seed),
        "whole traces, photodiode": lambda seed: from_traces(cell, RecorderSettings(), 0.0, seed),
    }
    print(f"{'':38}{'z_et sd um':>11}{'rms error':>10}{'z^2':>6}" + "".join(f"{name + ' nm':>11}" for name in TASKS))
    shown = {}
    for name, make in cases.items():
        began = time.perf_counter()
        estimates = [make(seed) for seed in range(options.replicates)]
        errors = np.array([e.values[at] - truth.values[0][at] for e in estimates])
        sds = np.array([e.sd[at] for e in estimates])
        tasks = np.median([task_sds(e) for e in estimates], axis=0)
        shown[name] = np.median([e.sd / cell.free.prior_sd for e in estimates], axis=0)
        print(
            f"{name:38}{np.median(sds):11.3f}{np.sqrt(np.mean(errors**2)):10.3f}{np.mean((errors / sds) ** 2):6.2f}"
            + "".join(f"{value:11.3f}" for value in tasks)
            + f"   {time.perf_counter() - began:.0f} s",
            flush=True,
        )
    print(
        f"Bound for 40 readings of 5 nm a sweep: z_et {bound(cell, False):.2f} um with the length at the start of each "
        f"sweep unknown, {bound(cell, True):.2f} um with it known."
    )

    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axis = figure.subplots()
    for (name, values), marker in zip(shown.items(), "os^pDv", strict=True):
        axis.semilogy(cell.free.names, values, marker, label=name, markersize=5)
    axis.set(ylabel="posterior sd / prior sd")
    axis.tick_params(axis="x", rotation=60)
    axis.legend(fontsize=8)
    options.output.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.output / "whole-traces.png", dpi=130)
    ends, whole = (float(v[at]) for v in (shown["end points, 5 nm"], shown["whole traces, 40 points of 5 nm"]))
    print(
        f"Whole traces know z_et {ends / whole:.0f} times as closely as end points with the same noise on each reading."
    )


if __name__ == "__main__":
    main()
