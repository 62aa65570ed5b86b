"""Plans drawn: in the workspace, and their accuracy against the number of sweeps."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.markup import escape
from rich.table import Table

from fpcal_bayes.infer.design.exchange import ChosenSweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.fit import plain_table

#: Expected standard deviation of each task in um, by what is measured.
Outlook = Mapping[str, Mapping[str, float]]


def accuracy_table(expected: Outlook, title: str) -> Table:
    """A line a task: expected worst-point standard deviation, a column for each thing that could be measured.

    Parameters
    ----------
    expected
        In um; ``plan`` is compared with the one called ``paper`` if it is there.
    """
    ratio = "paper" in expected and "plan" in expected
    columns = ["task", "", *[f"{name} nm" for name in expected]] + (["plan / paper"] if ratio else [])
    table = plain_table(title, columns)
    for task in next(iter(expected.values())):
        row = [escape(task), "sd", *[f"{1e3 * sd[task]:.3g}" for sd in expected.values()]]
        if ratio:
            row.append(f"{expected['plan'][task] / expected['paper'][task]:.2f}")
        table.add_row(*row)
    return table


def sweeps_table(cell: Cell, sweeps: Sweeps, title: str) -> Table:
    """A line a sweep, in the order in which they are made: where the joints stand and which of them move."""
    names = [f"q{i} {joint.unit}" for i, joint in enumerate(cell.joints, 1)]
    table = plain_table(title, ["sweep", "moves", *names])
    starts, ends = sweeps.q_start / cell.joint_scales, sweeps.q_end / cell.joint_scales
    for label, start, end in zip(sweeps.label.tolist(), starts.tolist(), ends.tolist(), strict=True):
        moved = [s != e for s, e in zip(start, end, strict=True)]
        cells = [f"{s:.4g}" if s == e else f"{s:.4g} .. {e:.4g}" for s, e in zip(start, end, strict=True)]
        table.add_row(escape(label), " ".join(f"q{i}" for i, m in enumerate(moved, 1) if m), *cells)
    return table


def plan_content(
    chosen: ChosenSweeps,
    ordered: Sweeps,
    expected: Outlook,
    seconds: Mapping[str, float],
    settings: Mapping[str, Any],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """What ``plan --json`` writes, without schema and command.

    Parameters
    ----------
    ordered
        The sweeps in the order in which they are made.
    expected
        As in `accuracy_table`.
    seconds
        Time that each of the same would take.
    settings
        How the plan was searched.
    """
    return {
        "n_sweeps": len(chosen),
        "order": ordered.label.tolist(),
        "most_useful_first": chosen.sweeps.label.tolist(),
        "expected_sd_nm": {what: {task: 1e3 * value for task, value in sd.items()} for what, sd in expected.items()},
        "sd_after_nm": {task: (1e3 * sd).tolist() for task, sd in chosen.sd.items()},
        "seconds": dict(seconds),
        "settings": dict(settings),
        "warnings": list(warnings),
    }


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
