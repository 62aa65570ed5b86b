"""A plan of sweeps as tables and as JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from fpcal_bayes.infer.planning.choose import ChosenSweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.report.tables import plain_table

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
