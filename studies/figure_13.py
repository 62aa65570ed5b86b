"""The paper's Fig 13: the circle every 2 h for 14 h after a full calibration, without calibrating again.

Between the paper's tables of day 0 and day 1 the truth moves on a straight line, or walks at random with the drift
sizes of the cell: one of many walks is what a single experiment sees.

    python studies/figure_13.py [--opd perpendicular]
"""

import numpy as np
from figure_common import Rig, arguments, save
from matplotlib.figure import Figure

from fpcal_bayes.core import paper_tables
from fpcal_bayes.infer import peak_to_peak, task_errors
from fpcal_bayes.measure import paper_truth
from fpcal_bayes.motion import task_path
from fpcal_bayes.tracking import DriftModel

HOURS = np.arange(0.0, 15.0, 2.0)
WALKS, POINTS = 1000, 181


def main() -> None:
    options = arguments(__doc__)
    rig = Rig.of(options.opd)
    estimate = rig.calibrated()
    circle = task_path(rig.cell, estimate.vector(), "circle", n_points=POINTS)
    expected = rig.model.predict(estimate.values, rig.model.pose_rows(circle.q))
    steady = paper_truth(rig.cell).at(HOURS)
    line = 1e3 * peak_to_peak(task_errors(rig.model, steady, estimate.values, circle))

    drift = DriftModel.of(rig.cell)
    random = np.random.default_rng(0)
    steps = random.standard_normal((WALKS, len(HOURS) - 1, drift.n_parameters)) * drift.walk * drift.scale
    moved = np.cumsum(steps * np.sqrt(np.diff(HOURS) / 24.0)[:, None], axis=1)
    walked = rig.truth + np.concatenate([np.zeros((WALKS, 1, drift.n_parameters)), moved], axis=1)
    errors = task_errors(rig.model, walked.reshape(-1, drift.n_parameters), estimate.values, circle)
    peaks = 1e3 * peak_to_peak(errors).reshape(WALKS, -1)
    low, median, high = np.quantile(peaks, [0.05, 0.5, 0.95], axis=0)
    tolerance = paper_tables()["claims"]["position_accuracy_nm"]
    left = [float(HOURS[np.argmax(row > tolerance)]) if (row > tolerance).any() else np.inf for row in peaks]

    figure = Figure(figsize=(9, 8), layout="constrained")
    top, bottom = figure.subplots(2, 1)
    quarter = rig.cell.wavelength / 8.0
    for hours, truth in zip(HOURS, steady, strict=True):
        change = rig.model.predict(truth, rig.model.pose_rows(circle.q)) - expected
        # As in the experiment the fringe stands where it is steepest.
        signal = (1.0 + np.cos(4.0 * np.pi * (change - change[0] + quarter) / rig.cell.wavelength)) / 2.0
        top.plot(circle.along, signal, label=f"T0 + {hours:g} h", color=str(0.85 - 0.06 * hours))
    top.set(
        xlabel="phase [deg]",
        ylabel="irradiance",
        ylim=(0, 1.05),
        title="Fig 13: circle after the calibration, steady drift",
    )
    top.legend(ncols=4, fontsize=8)
    bottom.fill_between(HOURS, low, high, alpha=0.25, label="random walks, 5 to 95 %", color="#0072B2")
    bottom.plot(HOURS, median, label="random walks, median", color="#0072B2")
    bottom.plot(HOURS, line, "o--", label="steady drift from day 0 to day 1", color="#D55E00")
    bottom.axhline(tolerance, color="k", linestyle=":", label=f"{tolerance:g} nm")
    bottom.set(xlabel="time since the calibration [h]", ylabel="peak to peak of the circle [nm]")
    bottom.legend(fontsize=8)
    at8, at14 = (int(HOURS.tolist().index(hours)) for hours in (8, 14))
    save(
        figure,
        options,
        "figure-13",
        "constant for the first 8 h, begins to depart after 10 h, more after 12 and 14 h.",
        f"steady drift: {line[at8]:.0f} nm after 8 h, {line[at14]:.0f} nm after 14 h; random walks: median "
        f"{median[at8]:.0f} nm after 8 h, {median[at14]:.0f} nm after 14 h; half of the walks have left "
        f"{tolerance:g} nm by the check at {np.median(left):g} h. The paper's 8 to 10 h lie between the two.",
    )


if __name__ == "__main__":
    main()
