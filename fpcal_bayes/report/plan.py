"""A plan as tables and as JSON: which sweeps, and how well each task will then be known."""

from collections.abc import Mapping, Sequence
from typing import Any

from fpcal_bayes.infer.design.exchange import ChosenSweeps
from fpcal_bayes.infer.design.plan import Frontier
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.table import Table, plain_table

#: Expected standard deviation of each task in um, by what is measured.
TaskForecast = Mapping[str, Mapping[str, float]]


def accuracy_table(expected: TaskForecast, title: str) -> Table:
    """One line per task: expected worst-point sd, a column per thing to measure; ``plan`` compared with ``paper``."""
    ratio = "paper" in expected and "plan" in expected
    heads = ["task", "", *(f"{name} [nm]" for name in expected), *(["plan / paper"] if ratio else [])]
    table = plain_table(title, heads)
    for task in next(iter(expected.values())):
        row = [task, "sd", *[f"{1e3 * sd[task]:.3g}" for sd in expected.values()]]
        if ratio:
            row.append(f"{expected['plan'][task] / expected['paper'][task]:.2f}")
        table.add_row(*row)
    return table


def sweeps_table(cell: Cell, sweeps: Sweeps, title: str, names: Sequence[str] | None = None) -> Table:
    """One line per sweep: which joints move, and where each stands or where it begins and ends; um and deg."""
    table = plain_table(title, ["sweep", "moves", *[f"q{i} [{joint.unit}]" for i, joint in enumerate(cell.joints, 1)]])
    # Adding zero turns -0 into 0.
    starts, ends = sweeps.q_start / cell.joint_scales + 0.0, sweeps.q_end / cell.joint_scales + 0.0
    for name, start, end in zip(names or sweeps.label.tolist(), starts.tolist(), ends.tolist(), strict=True):
        moving = [f"q{i}" for i, (a, b) in enumerate(zip(start, end, strict=True), 1) if a != b]
        shown = [f"{a:.4g}" if a == b else f"{a:.4g} .. {b:.4g}" for a, b in zip(start, end, strict=True)]
        table.add_row(name, " ".join(moving), *shown)
    return table


def plan_content(
    chosen: ChosenSweeps,
    ordered: Sweeps,
    expected: TaskForecast | None,
    seconds: Mapping[str, float],
    settings: Mapping[str, Any],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """What ``plan --json`` writes of the sweeps `ordered`; `expected` is None where what is known is not to be used."""
    return {
        "n_sweeps": len(chosen),
        "should_stop": False,
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


def frontier_content(frontier: Frontier) -> dict[str, Any]:
    """The frontier as JSON."""
    plans = [
        {
            "n_sweeps": point.sweeps,
            "seconds": point.seconds,
            "expected_sd_nm": {task: 1e3 * sd for task, sd in point.sd.items()},
        }
        for point in frontier.points
    ]
    return {"plans": plans, "knee": frontier.points[frontier.knee].sweeps}
