"""Uncertainty budgets as tables and as JSON."""

from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.budget import COVERAGE, Budget
from fpcal_bayes.infer.tasks.prediction import BAND, TaskPrediction
from fpcal_bayes.motion.tasks import Task
from fpcal_bayes.report.fit import plain_table


def prediction_content(prediction: TaskPrediction, tolerance: float | None, task: Task) -> dict[str, Any]:
    """A prediction as JSON: bands along the path in nm, peak to peak, angles in deg.

    Parameters
    ----------
    tolerance
        In um, or None.
    task
        The whole task, of which the points that are ok are predicted; the others have nulls.
    """
    angles = prediction.angles
    low, high = 1e3 * prediction.band()
    ends = 1e3 * prediction.peak_to_peak_band()
    content: dict[str, Any] = {
        "method": "linear" if prediction.linear else "draws",
        "draws": len(prediction.errors),
        "points": len(task),
        "points_not_ok": int((~task.ok).sum()),
        "along": task.along.tolist(),
        "along_unit": task.unit,
        "status": task.status.tolist(),
        "sd_nm": _whole(1e3 * prediction.sd, task),
        "band_nm": {"share": BAND, "low": _whole(low, task), "high": _whole(high, task)},
        "worst_sd_nm": float(1e3 * prediction.sd.max()),
        "peak_to_peak_nm": {
            "median": float(1e3 * np.median(prediction.peak_to_peak)),
            "low": float(ends[0]),
            "high": float(ends[1]),
            "share": BAND,
        },
        "normal_deg": _quantiles(angles.normal.max(axis=1)),
        "turn_deg": _quantiles(angles.turn.max(axis=1)),
    }
    if tolerance is not None:
        content["tolerance_nm"] = 1e3 * tolerance
        content["exceeds_probability"] = prediction.exceeds(tolerance)
    return content


def prediction_table(predictions: list[TaskPrediction], tolerance: float | None, title: str) -> Table:
    """A line a task: worst standard deviation, peak to peak with its band, angles, probability of exceeding."""
    columns = ["task", "path", "worst sd nm", "pk-pk nm", f"{BAND:.0%} band nm", "normal 95 % deg", "turn 95 % deg"]
    if tolerance is not None:
        columns.append(f"P(> {1e3 * tolerance:g} nm)")
    table = plain_table(title, columns)
    for prediction in predictions:
        task, (low, high) = prediction.task, 1e3 * prediction.peak_to_peak_band()
        row = [
            escape(task.name),
            f"{task.along[0]:.4g} .. {task.along[-1]:.4g} {task.unit}",
            f"{1e3 * prediction.sd.max():.2f}",
            f"{1e3 * np.median(prediction.peak_to_peak):.2f}",
            f"{low:.2f} .. {high:.2f}",
            _angle(prediction.angles.normal),
            _angle(prediction.angles.turn),
        ]
        if tolerance is not None:
            row.append(f"{prediction.exceeds(tolerance):.3f}")
        table.add_row(*row)
    return table


def reach_warnings(task: Task) -> list[str]:
    """A sentence if points of a task cannot be driven to, else nothing."""
    if task.ok.all():
        return []
    first = int(np.argmin(task.ok))
    return [
        f"task {task.name}: {int((~task.ok).sum())} of {len(task)} points cannot be driven to; point {first + 1}: "
        f"{task.status[first]}"
    ]


def _whole(driven: Floats, task: Task) -> list[float | None]:
    """Numbers of the points that are ok, with nothing in the place of the others."""
    numbers = iter(driven.tolist())
    return [next(numbers) if good else None for good in task.ok]


def _angle(along: Floats) -> str:
    """The 95 % quantile of the largest angle along the path; what rounding leaves is nothing."""
    high = _quantiles(along.max(axis=1))["q95"]
    return f"{high:.2g}" if high > 1e-9 else "0"


def _quantiles(worst: Floats) -> dict[str, float]:
    median, high = np.quantile(worst, [0.5, 0.95])
    return {"median": float(median), "q95": float(high)}


def budget_content(budget: Budget) -> dict[str, Any]:
    """A budget as JSON; contributions and results in nm."""
    return {
        "at": {"along": budget.along, "unit": budget.unit},
        "inputs": [
            {
                "input": line.name,
                "type": line.evaluation,
                "distribution": line.distribution,
                "estimate": line.estimate,
                "standard_uncertainty": line.standard_uncertainty,
                "unit": line.unit,
                "sensitivity_nm_per_unit": 1e3 * line.sensitivity,
                "contribution_nm": 1e3 * line.contribution,
            }
            for line in budget.lines
        ],
        "correlation": budget.correlation.tolist(),
        "combined_nm": 1e3 * budget.combined,
        "coverage": {"share": COVERAGE, "low_nm": 1e3 * budget.interval[0], "high_nm": 1e3 * budget.interval[1]},
    }


def budget_table(budget: Budget) -> Table:
    """A line an input, then what they combine to."""
    place = f"{budget.along:.4g} {budget.unit}"
    table = plain_table(
        f"uncertainty budget of {budget.task} at {place}: change of cavity length since the aligned pose",
        ["input", "type", "distribution", "estimate", "std. uncertainty", "sensitivity nm", "contribution nm"],
    )
    for line in budget.lines:
        table.add_row(
            escape(line.name),
            line.evaluation,
            line.distribution,
            f"{line.estimate:g}",
            f"{line.standard_uncertainty:.3g} {line.unit}",
            f"{1e3 * line.sensitivity:.3g} / {line.unit}",
            f"{1e3 * line.contribution:.3g}",
        )
    low, high = budget.interval
    table.add_section()
    table.add_row("combined standard uncertainty", "", "", "", "", "", f"{1e3 * budget.combined:.3g}")
    table.add_row(f"{COVERAGE:.0%} coverage interval", "", "", "", "", "", f"{1e3 * low:.3g} .. {1e3 * high:.3g}")
    return table


def correlation_lines(budget: Budget) -> list[str]:
    """A line for each pair of inputs whose contributions are correlated by half a per cent or more."""
    names = [line.name for line in budget.lines]
    return [
        f"correlation of {names[j]} with {names[i]}: {budget.correlation[i, j]:+.3f}"
        for i in range(len(names))
        for j in range(i)
        if abs(budget.correlation[i, j]) >= 0.005
    ]
