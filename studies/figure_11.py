"""The paper's Fig 11: rotation about the optical axis with the reflection point held, until a translation saturates.

Beyond the first joint limit the stage stays where it is, as the hardware does, and fringes return.

    python studies/figure_11.py [--opd perpendicular]
"""

import numpy as np
from figure_common import Rig, arguments, save
from matplotlib.figure import Figure

from fpcal_bayes.model import chain
from fpcal_bayes.motion import Controller, task_path

BEYOND = 12.0


def main() -> None:
    options = arguments(__doc__)
    rig = Rig.of(options.opd)
    estimate = rig.calibrated()
    ends = task_path(rig.cell, estimate.vector(), "spin").along[[0, -1]]
    angle = np.linspace(ends[0] - BEYOND, ends[1] + BEYOND, 4001)
    offsets = np.zeros((len(angle), 6))
    offsets[:, 4] = np.radians(angle)
    task = Controller(estimate).follow("spin", offsets)
    q = np.clip(task.q, rig.cell.low, rig.cell.high)
    _, point = chain.reflection_point(rig.cell, estimate.vector(), np.zeros(6))

    figure = Figure(figsize=(9, 8.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    axes[0].plot(angle, rig.irradiance(q), linewidth=0.7)
    axes[0].set(ylim=(0, 1.05), ylabel="irradiance", title="Fig 11: spin about the optical axis after full calibration")
    for i in range(3):
        axes[1].plot(angle, q[:, i], label=f"q{i + 1}")
    for i in (3, 4):
        axes[2].plot(angle, np.degrees(q[:, i]), label=f"q{i + 1}")
    axes[1].set_ylabel("um")
    axes[2].set(ylabel="deg", xlabel="turn about Yf [deg]")
    for axis in axes:
        for end in ends:
            axis.axvline(end, color="0.6", linewidth=0.8)
    for axis in axes[1:]:
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    px, py = point[:2]
    driven = (angle >= ends[0]) & (angle <= ends[1])
    change = rig.change_nm(task.take(driven))
    joints, beyond = [], []
    for side in (angle < ends[0], angle > ends[1]):
        past = np.argmin(np.where(side, np.abs(angle), np.inf))
        joints.append(str(task.status[past]).removeprefix("saturated: ").split(" (")[0])
        beyond.append(rig.fringes(1e3 * np.ptp(rig.lengths(q[side]))))
    save(
        figure,
        options,
        "figure-11",
        "irradiance constant until at least one translation saturates, then fringes; reflection point on the mirror "
        "(141.1, 116.34) um. The angle is not printed.",
        f"constant ({change:.1f} nm) from {ends[0]:.1f} deg ({joints[0]}) to {ends[1]:.1f} deg ({joints[1]}); "
        f"{beyond[0]:.2f} and {beyond[1]:.2f} fringes in the {BEYOND:g} deg beyond: a translation that stays behind is "
        f"felt as far as its axis is out of the mirror plane. Reflection point ({px:.1f}, {py:.1f}) um from Tables II "
        "and III; the printed one does not follow from the tables.",
    )


if __name__ == "__main__":
    main()
