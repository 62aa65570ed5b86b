"""Plans drawn: in the workspace, and their accuracy against the number of sweeps."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell import Cell

# Okabe and Ito's colours.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_MARKERS = ("o", "s", "^", "v", "D", "P", "X")


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
            place = (start[across], start[up])
            axis.annotate(str(number + 1), place, (3, 3), textcoords="offset points", fontsize=7, color=colour)
        axis.set_xlabel(f"q{across + 1} [{cell.joints[across].unit}]")
        axis.set_ylabel(f"q{up + 1} [{cell.joints[up].unit}]")
        axis.grid(alpha=0.3)
    return figure


def draw_accuracy(
    found: Mapping[str, Mapping[int, Mapping[str, float]]], levels: Mapping[str, Mapping[str, float]]
) -> Figure:
    """Draw the accuracy of each task against the number of sweeps, a panel a task and a line a way of choosing them.

    Parameters
    ----------
    found
        Standard deviation of each task in um, by the way and the number of sweeps.
    levels
        What is drawn across for comparison, by its name.
    """
    tasks = list(next(iter(levels.values())))
    figure = Figure(figsize=(2.9 * len(tasks), 3.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(tasks)))
    for axis, task in zip(axes, tasks, strict=True):
        for style, (name, sd) in zip(("--", ":"), levels.items(), strict=False):
            axis.axhline(1e3 * sd[task], color="0.35", linestyle=style, linewidth=1.2, label=name)
        for colour, marker, (name, of_way) in zip(_COLOURS, _MARKERS, found.items(), strict=False):
            numbers = sorted(of_way)
            sizes = [1e3 * of_way[n][task] for n in numbers]
            axis.plot(numbers, sizes, color=colour, marker=marker, markersize=4, linewidth=1.3, label=name)
        axis.set_xticks(sorted({n for of_way in found.values() for n in of_way}))
        axis.set_yscale("log")
        axis.set_title(task)
        axis.set_xlabel("sweeps")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("expected standard deviation [nm]")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure
