"""The paper's own cell with error motions of catalogue size, beside its claim of 50 nm.

Six tasks after the paper's 69 sweeps, and after the same with midpoints, on one simulated machine: what a perfect
mechanism promises, what the cell's stated mechanics predict (95 %), and what the sweeps of the machine itself leave.

    python studies/figure_mechanics.py [--output docs/explanation/mechanics.png]
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes import TASKS, find_task, identify, load_cell, paper_truth, predict_from_covariance, simulate
from fpcal_bayes.measure import protocol_by_name

PROTOCOLS = {"paper": "69 sweeps, end points", "paper-mid": "with midpoints"}
POINTS = 31


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("mechanics.png"))
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    machine, ideal = load_cell(), load_cell(mechanics="none")
    truth, rows = paper_truth(ideal), {}
    for protocol, word in PROTOCOLS.items():
        for cell, of in ((ideal, "perfect mechanism"), (machine, "stated mechanics")):
            sweeps = simulate(cell, truth, protocol_by_name(protocol, cell), sigma_nm=5.0, seed=options.seed)
            estimate = identify(cell, sweeps).estimate
            theta = estimate.shown()["theta_wf"]["sd"]
            bands = []
            for name in TASKS:
                task = find_task(cell, estimate.vector(), name, n_points=POINTS).driven()
                predicted = predict_from_covariance(estimate, task, draws=4000)
                middle = 1e3 * float(np.median(predicted.peak_to_peak))
                bands.append((middle, *(1e3 * predicted.peak_to_peak_band())))
            rows[f"{of}, {word}"] = np.array(bands)
            shown = ", ".join(
                f"{task} {middle:.0f} ({low:.0f}..{high:.0f})"
                for task, (middle, low, high) in zip(TASKS, bands, strict=True)
            )
            print(f"{of}, {word}: theta_wf {theta:.3f} deg; nm: {shown}")

    figure = Figure((8.0, 4.6), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(TASKS), dtype=float)
    for i, (word, bands) in enumerate(rows.items()):
        middle, low, high = bands.T
        at = place + 0.18 * (i - 1.5)
        axis.errorbar(at, middle, [middle - low, high - middle], fmt="os^v"[i], markersize=5, capsize=3, label=word)
    axis.axhline(50.0, color="black", linestyle="--", linewidth=1.0)
    axis.annotate("50 nm, the paper's claim", (place[-1] + 0.45, 52.0), ha="right", va="bottom", fontsize=8)
    axis.set_yscale("log")
    axis.set_xticks(place, list(TASKS))
    axis.set_ylabel("task error, peak to peak [nm], 95 %")
    axis.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    figure.savefig(options.output, dpi=120)


if __name__ == "__main__":
    main()
