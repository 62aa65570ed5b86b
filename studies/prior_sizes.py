"""Priors that are wrong: stated ten times too small and too large, do the bands of the tasks still hold?

python studies/prior_sizes.py [--truths 40] [--first 0] [--factor 0.1 1 10] [--protocol paper-mid] [--machine]

Truths are drawn from the priors of the built-in cell; the cell that is identified states priors that are `factor` times
as wide. With `--machine` truths are realistic machines of another family than the fit's, and the cell states their
mechanics. For each: share of true peak-to-peak errors inside their 95 % bands (and at or below their upper ends), how
many estimates are not to be used, and of how many it is said that the data contradict the stated priors.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from mechanics_coverage import MIXTURES, reachable

from fpcal_bayes import InputError
from fpcal_bayes.infer import identify, peak_to_peak, predict_from_covariance, task_errors
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, drive_of_sweeps, protocol_by_name
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import TASKS, task_path
from fpcal_bayes.simulator import Machine

#: Standard deviation of a reading, in um.
_SIGMA = 0.005


def stating(cell: Cell, factor: float) -> Cell:
    """The cell with priors `factor` times as wide."""
    parameters = (replace(p, prior_sd=factor * p.prior_sd) for p in cell.parameters)
    return replace(cell, parameters=type(cell.parameters)(parameters))


def measured_on(model: CavityModel, truth: np.ndarray, plan: Sweeps, rng: np.random.Generator) -> Sweeps:
    """The sweeps as a perfect mechanism gives them; rows of one group share the reading at their start."""
    exact = model.predict(truth, model.rows(plan.q_start, plan.q_end, plan.absolute))
    shared = np.unique(plan.group, return_inverse=True)[1] if (plan.group != "").any() else np.arange(len(plan))
    reading = rng.standard_normal(shared.max() + 1)[shared] + rng.standard_normal(len(plan))
    return plan.with_measurement(exact + _SIGMA * reading / np.sqrt(2.0), _SIGMA)


def one_truth(cell: Cell, stated: Cell, protocol: str, seed: int, on_machine: bool) -> dict[str, object]:
    rng, model = np.random.default_rng([seed, 31]), CavityModel.of(cell)
    plan, truth, machine = protocol_by_name(protocol, cell), reachable(cell, rng)[cell.free.slots], None
    if on_machine:
        sizes, settings, _ = MIXTURES["realistic"]
        machine = Machine.draw(cell, sizes, model.vector(truth), rng, settings)
        drive = drive_of_sweeps(plan, sizes.minutes_per_sweep)
        measured = plan.with_measurement(machine.sweep(drive, _SIGMA), _SIGMA)
    else:
        measured = measured_on(model, truth, plan, rng)
    found = identify(stated, measured, seed=seed)
    result: dict[str, object] = {
        "usable": found.estimate.trust.usable,
        "said": [reason.text for reason in found.estimate.trust.reasons],
        "kinds": [reason.kind for reason in found.estimate.trust.reasons],
    }
    for name in TASKS:
        try:
            task = task_path(stated, found.estimate.vector(), name, n_points=31)
        except InputError:
            continue
        if found.estimate.trust.usable and task.finite.all():
            low, high = predict_from_covariance(found.estimate, task, draws=2000).peak_to_peak_band()
            if machine is None:
                true = float(peak_to_peak(task_errors(model, truth, found.estimate.values, task))[0])
            else:
                rows = model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)
                when = float(rng.choice([0.0, drive.end_min.max()]))
                true = float(
                    np.ptp(machine.path(task.start, task.q, when) - model.predict(found.estimate.values, rows))
                )
            result[name] = (true, low, high)
    return result


def summary(results: list[dict[str, object]]) -> str:
    parts = []
    for name in TASKS:
        judged = np.array([r[name] for r in results if name in r])
        if len(judged):
            true, low, high = judged.T
            inside, below = ((true >= low) & (true <= high)).mean(), (true <= high).mean()
            parts.append(
                f"{name} {100 * inside:.0f}/{100 * below:.0f} of {len(judged)} (up to {1e3 * np.median(high):.2g} nm)"
            )
    unusable = sum(not r["usable"] for r in results)
    warned = [r for r in results if "priors" in r["kinds"]]  # type: ignore[operator]
    told = [text for r in warned for text, kind in zip(r["said"], r["kinds"], strict=True) if kind == "priors"]  # type: ignore[call-overload]
    return f"{'; '.join(parts)}; not to be used {unusable}, warned {len(warned)} of {len(results)}" + (
        f": {told[0]}" if told else ""
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first truth")
    parser.add_argument("--machine", action="store_true", help="realistic machines, whose mechanics are stated")
    parser.add_argument("--factor", type=float, nargs="*", default=[0.1, 1.0, 10.0])
    parser.add_argument("--protocol", default="paper-mid")
    parser.add_argument("--json", type=Path, help="append a line per truth")
    options = parser.parse_args()
    cell = load_cell(mechanics="none")
    for factor in options.factor:
        stated, results = stating(cell, factor), []
        if options.machine:
            stated = replace(stated, mechanics=MIXTURES["realistic"][0])
        for seed in range(options.first, options.first + options.truths):
            results.append(one_truth(cell, stated, options.protocol, seed, options.machine))
            if options.json:
                with options.json.open("a") as lines:
                    lines.write(json.dumps({"factor": factor, "seed": seed} | results[-1]) + "\n")
        print(f"priors {factor:g} times the truth's, {options.protocol}: {summary(results)}", flush=True)


if __name__ == "__main__":
    main()
