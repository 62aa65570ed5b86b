"""Priors that are wrong: stated ten times too small and too large, do the bands of the tasks still hold?

python studies/prior_sizes.py [--truths 40] [--factor 0.1 1 10] [--protocol paper-mid]

Truths are drawn from the priors of the built-in cell; the cell that is identified states priors that are `factor` times
as wide. For each: share of the true peak-to-peak errors inside their 95 % bands (and at or below their upper ends), how
many estimates are not to be used, and of how many it is said that the data contradict the stated priors.
"""

import argparse
from dataclasses import replace

import numpy as np
from mechanics_coverage import reachable

from fpcal_bayes import InputError
from fpcal_bayes.infer import identify, peak_to_peak, predict_from_covariance, task_errors
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import protocol_by_name
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.motion import TASKS, task_path


def stating(cell: Cell, factor: float) -> Cell:
    """The cell with priors `factor` times as wide."""
    parameters = (replace(p, prior_sd=factor * p.prior_sd) for p in cell.parameters)
    return replace(cell, parameters=type(cell.parameters)(parameters))


def one_truth(cell: Cell, stated: Cell, protocol: str, seed: int) -> dict[str, object]:
    rng, model = np.random.default_rng([seed, 31]), CavityModel.of(cell)
    plan, truth = protocol_by_name(protocol, cell), reachable(cell, rng)[cell.free.slots]
    exact = model.predict(truth, model.rows(plan.q_start, plan.q_end, plan.absolute))
    shared = np.unique(plan.group, return_inverse=True)[1] if (plan.group != "").any() else np.arange(len(plan))
    reading = rng.standard_normal(shared.max() + 1)[shared] + rng.standard_normal(len(plan))
    found = identify(stated, plan.with_measurement(exact + 0.005 * reading / np.sqrt(2.0), 0.005), seed=seed)
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
            result[name] = (float(peak_to_peak(task_errors(model, truth, found.estimate.values, task))[0]), low, high)
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
    parser.add_argument("--factor", type=float, nargs="*", default=[0.1, 1.0, 10.0])
    parser.add_argument("--protocol", default="paper-mid")
    options = parser.parse_args()
    cell = load_cell(mechanics="none")
    for factor in options.factor:
        stated = stating(cell, factor)
        results = [one_truth(cell, stated, options.protocol, seed) for seed in range(options.truths)]
        print(f"priors {factor:g} times the truth's, {options.protocol}: {summary(results)}", flush=True)


if __name__ == "__main__":
    main()
