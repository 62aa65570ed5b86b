"""The paper's Figs 9 and 10: a rotation of q6 and a circle in the mirror plane, before calibration.

python studies/figure_09_10.py [--opd perpendicular]
"""

import numpy as np
from figure_common import Rig, arguments, save
from matplotlib.figure import Figure

from fpcal_bayes.motion import task_path


def main() -> None:
    options = arguments(__doc__)
    rig = Rig.of(options.opd)
    angle = np.linspace(0.0, 90.0, 20_001)
    turn = np.zeros((len(angle), 6))
    turn[:, 5] = np.radians(angle)
    circle = task_path(rig.cell, rig.cell.parameters.nominal, "circle", n_points=20_001)

    figure = Figure(figsize=(9, 6.5), layout="constrained")
    top, bottom = figure.subplots(2, 1)
    top.plot(angle, rig.irradiance(turn), linewidth=0.6)
    top.set(xlabel="q6 [deg]", ylabel="irradiance", title="Fig 9: rotation of q6 before calibration")
    bottom.plot(circle.along, rig.irradiance(circle.q), linewidth=0.6)
    bottom.set(xlabel="phase [deg]", ylabel="irradiance", title="Fig 10: circle of 100 um radius before calibration")
    changes = 1e3 * np.ptp(rig.lengths(turn)), rig.change_nm(circle)
    save(
        figure,
        options,
        "figure-09-10",
        "fringes on both; neither their number nor the radius of the circle is printed.",
        f"90 deg of q6: {changes[0]:.0f} nm, {rig.fringes(changes[0]):.1f} fringes of half a wavelength; circle: "
        f"{changes[1]:.0f} nm, {rig.fringes(changes[1]):.1f} fringes.",
    )


if __name__ == "__main__":
    main()
