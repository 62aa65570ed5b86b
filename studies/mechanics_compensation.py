"""What a machine gains when its controller makes up for the error motions that the calibration found.

python studies/mechanics_compensation.py [--mixture realistic ...] [--readings 8] [--truths 40]

Each simulated machine is calibrated by the paper's sweeps, read so many times each, and driven along the tasks, 31
points each, with and without compensation: medians over machines of the true peak to peak, in a single pass and without
what is new each time.
"""

import argparse
from dataclasses import replace

import numpy as np
from mechanics_coverage import MIXTURES, reachable, sheet_of

from fpcal_bayes import InputError, identify, predict_from_covariance
from fpcal_bayes.infer import PATH_POINTS
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import drive_of_sweeps, protocol_by_name, read_often
from fpcal_bayes.model import CavityModel
from fpcal_bayes.motion import TASKS, Task, compensated, task_path
from fpcal_bayes.simulator import Machine

SIGMA = 0.005


def true_error(machine: Machine, model: CavityModel, values: np.ndarray, task: Task, minutes: float) -> float:
    """Peak to peak of what a machine does beyond what is wanted, in nm."""
    rows = model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)
    wanted = model.predict(values, rows) - (0.0 if task.added is None else task.added)
    return 1e3 * float(np.ptp(machine.path(task.start, task.q, minutes) - wanted))


def one_machine(name: str, readings: int, seed: int) -> dict[str, tuple[float, ...]]:
    """By task: true peak to peak without and with compensation, both of the repeatable part, and the predicted ones."""
    sizes, settings, _ = MIXTURES[name]
    cell = replace(load_cell(), mechanics=sheet_of(name))
    rng = np.random.default_rng([seed, 31])
    vector = reachable(cell, rng)
    machine = Machine.draw(cell, sizes, vector, rng, settings)
    plan = read_often(protocol_by_name("paper", cell), readings)
    drive = drive_of_sweeps(plan, sheet_of(name).minutes_per_sweep)
    estimate = identify(cell, plan.with_measurement(machine.sweep(drive, SIGMA), SIGMA)).estimate
    if not estimate.trust.usable:
        # No controller drives with it.
        return {}
    model = CavityModel.of(cell, estimate.parameters)
    found = {}
    for task_name in TASKS:
        try:
            task = task_path(cell, estimate.vector(), task_name, n_points=PATH_POINTS).driven()
        except InputError:
            continue
        better, when = compensated(estimate, task), float(rng.choice([0.0, 1.0])) * float(drive.end_min.max())
        calm = replace(machine, return_sd=0.0 * machine.return_sd)
        figures = []
        for one in (machine, calm):
            state = one.rng.bit_generator.state
            for path in (task, better):
                # Both see the same random numbers.
                one.rng.bit_generator.state = state
                figures.append(true_error(one, model, estimate.values, path, when))
        figures += [
            1e3 * float(np.median(predict_from_covariance(estimate, path).peak_to_peak)) for path in (task, better)
        ]
        found[task_name] = (*figures, float(better.added is not None))
    return found


def main() -> None:
    """Print a line per mixture and task."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mixture", nargs="*", default=["realistic"], choices=sorted(MIXTURES))
    parser.add_argument("--readings", type=int, default=8)
    parser.add_argument("--truths", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="seed of the first machine")
    options = parser.parse_args()
    for name in options.mixture:
        machines = [
            one_machine(name, options.readings, seed) for seed in range(options.first, options.first + options.truths)
        ]
        doubtful = sum(not found for found in machines)
        print(f"{name}: {len(machines)} machines, {doubtful} of them with a doubtful fit, which are left out")
        for task in TASKS:
            of_task = np.array([found[task] for found in machines if task in found])
            if not len(of_task):
                continue
            single, better, calm, calmer, said, promised, _ = np.median(of_task, axis=0)
            print(
                f"{name} {task}: {single:.1f} -> {better:.1f} nm ({single / better:.2f}x), repeatable {calm:.1f} -> "
                f"{calmer:.1f} ({calm / max(calmer, 1e-9):.2f}x), predicted {said:.1f} -> {promised:.1f}, "
                f"used {100 * of_task[:, -1].mean():.0f} %",
                flush=True,
            )


if __name__ == "__main__":
    main()
