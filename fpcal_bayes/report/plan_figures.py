"""Figures of plans: which sweeps, and accuracy against their number and the time they take."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from fpcal_bayes.infer.design.plan import Frontier, Point
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.pages import BLUE, GREEN, VERMILION


def draw_plan(cell: Cell, sweeps: Sweeps) -> Figure:
    """Draw sweeps in their order, a panel per joint: a line from start to end where it moves, else a dot."""
    columns = 2 if len(cell.joints) > 1 else 1
    rows = -(-len(cell.joints) // columns)
    figure = Figure(figsize=(9.0, 1.0 + 1.9 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, sharex=True)).ravel()
    number = np.arange(1, len(sweeps) + 1)
    for joint, axis in enumerate(axes[: len(cell.joints)]):
        scale = cell.joint_scales[joint]
        start, end = sweeps.q_start[:, joint] / scale, sweeps.q_end[:, joint] / scale
        moves = start != end
        axis.plot(number[~moves], start[~moves], ".", color="0.6", markersize=5)
        axis.vlines(number[moves], start[moves], end[moves], color=BLUE, linewidth=2.0)
        axis.plot(number[moves], end[moves], "o", color=VERMILION, markersize=4)
        axis.set_ylabel(f"q{joint + 1} [{cell.joints[joint].unit}]")
        axis.grid(alpha=0.3)
    for axis in axes[len(cell.joints) :]:
        axis.set_axis_off()
    for axis in axes[max(0, len(cell.joints) - columns) : len(cell.joints)]:
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.tick_params(labelbottom=True)
        axis.set_xlabel("sweep")
    figure.suptitle("from the blue end to the red dot; a grey dot where the joint stands still", fontsize=9)
    return figure


def draw_frontier(frontier: Frontier, papers: Mapping[str, Point]) -> Figure:
    """Expected standard deviation of each task against sweeps and minutes, with the paper's protocol on it."""
    tasks = list(frontier.points[0].sd)
    figure = Figure(figsize=(2.7 * len(tasks), 5.4), layout="constrained")
    axes = np.atleast_2d(figure.subplots(2, len(tasks), sharey="col", squeeze=False))
    for row, across in enumerate(("sweeps", "minutes")):
        for axis, task in zip(axes[row], tasks, strict=True):
            x = [point.sweeps if row == 0 else point.seconds / 60.0 for point in frontier.points]
            sd = [1e3 * point.sd[task] for point in frontier.points]
            axis.plot(x, sd, color=BLUE, marker="o", markersize=4, label="plans")
            knee = frontier.knee
            axis.plot(x[knee], sd[knee], "o", color=BLUE, markersize=10, fillstyle="none", label="knee")
            for (name, point), colour, marker in zip(papers.items(), (VERMILION, GREEN), "s^", strict=False):
                at = point.sweeps if row == 0 else point.seconds / 60.0
                axis.plot(at, 1e3 * point.sd[task], marker, color=colour, label=name)
            axis.set(yscale="log", xlabel=across, title=task if row == 0 else "")
            axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("expected sd [nm]")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure
