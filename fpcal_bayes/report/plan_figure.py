"""A plan drawn in the workspace: which joints move, and from where to where."""

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell import Cell

# Okabe and Ito's colours.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def draw_plan(cell: Cell, sweeps: Sweeps) -> Figure:
    """Draw sweeps in the planes of neighbouring joints: a line where a joint moves, a dot where none of both does."""
    n_joints = len(cell.joints)
    pairs = [(i, i + 1) for i in range(n_joints - 1)] or [(0, 0)]
    figure = Figure(figsize=(3.2 * len(pairs), 3.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(pairs)))
    starts, ends = sweeps.q_start / cell.joint_scales, sweeps.q_end / cell.joint_scales
    for axis, (across, up) in zip(axes, pairs, strict=True):
        for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
            colour = _COLOURS[number % len(_COLOURS)]
            axis.plot(
                [start[across], end[across]],
                [start[up], end[up]],
                color=colour,
                marker="o",
                markersize=3,
                linewidth=1.2,
            )
            axis.annotate(str(number + 1), (start[across], start[up]), fontsize=7, color=colour)
        axis.set_xlabel(f"q{across + 1} [{cell.joints[across].unit}]")
        axis.set_ylabel(f"q{up + 1} [{cell.joints[up].unit}]")
        axis.grid(alpha=0.3)
    return figure
