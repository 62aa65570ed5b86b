"""A plan as tables, as JSON and as a figure: which sweeps, and how well each task will then be known."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.infer.design.exchange import ChosenSweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.pages import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from fpcal_bayes.report.table import Table, plain_table
from fpcal_bayes.report.track import add_sweeps

#: Expected standard deviation of each task in um, by what is measured.
TaskForecast = Mapping[str, Mapping[str, float]]


def accuracy_table(expected: TaskForecast, title: str) -> Table:
    """One line per task: expected worst-point standard deviation, a column for each thing that could be measured.

    What is called ``plan`` is compared with the one called ``paper`` if it is there.
    """
    ratio = "paper" in expected and "plan" in expected
    heads = ["task", "", *(f"{name} [nm]" for name in expected), *(["plan / paper"] if ratio else [])]
    table = plain_table(title, heads)
    for task in next(iter(expected.values())):
        row = [task, "sd", *[f"{1e3 * sd[task]:.3g}" for sd in expected.values()]]
        if ratio:
            row.append(f"{expected['plan'][task] / expected['paper'][task]:.2f}")
        table.add_row(*row)
    return table


def sweeps_table(cell: Cell, sweeps: Sweeps, title: str) -> Table:
    """One line per sweep, in the order in which they are made."""
    table = plain_table(title, ["sweep", "moves", *[f"q{i} {joint.unit}" for i, joint in enumerate(cell.joints, 1)]])
    add_sweeps(table, sweeps, cell, sweeps.label.tolist())
    return table


def plan_content(
    chosen: ChosenSweeps,
    ordered: Sweeps,
    expected: TaskForecast | None,
    seconds: Mapping[str, float],
    settings: Mapping[str, Any],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """What ``plan --json`` writes, without schema and command; `ordered` are the sweeps as they are made.

    `expected` is None where the plan is made from what is not to be used.
    """
    return {
        "n_sweeps": len(chosen),
        "order": ordered.label.tolist(),
        "most_useful_first": chosen.sweeps.label.tolist(),
        "expected_sd_nm": None
        if expected is None
        else {what: {task: 1e3 * value for task, value in sd.items()} for what, sd in expected.items()},
        "sd_after_nm": None if expected is None else {task: (1e3 * sd).tolist() for task, sd in chosen.sd.items()},
        "seconds": dict(seconds),
        "settings": dict(settings),
        "warnings": list(warnings),
    }


_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)


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
            line = [start[across], end[across]], [start[up], end[up]]
            axis.plot(*line, color=colour, marker="o", markersize=3, linewidth=1.2)
            place = (start[across], start[up])
            axis.annotate(str(number + 1), place, (3, 3), textcoords="offset points", fontsize=7, color=colour)
        axis.set_xlabel(f"q{across + 1} [{cell.joints[across].unit}]")
        axis.set_ylabel(f"q{up + 1} [{cell.joints[up].unit}]")
        axis.grid(alpha=0.3)
    return figure
