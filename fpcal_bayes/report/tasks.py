"""Task errors and uncertainty budgets as tables and as JSON."""

from typing import Any

import numpy as np

from fpcal_bayes.analysis.tasks import FreedomNumbers, TaskNumbers, correlated_inputs, freedom_numbers, variance_shares
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.budget import COVERAGE, Budget
from fpcal_bayes.infer.tasks.prediction import BAND, TaskPrediction
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import OwnTask
from fpcal_bayes.motion.tasks import Task
from fpcal_bayes.report.table import Table, plain_table

#: What no change of length tells, and what is told up to something.
NOT_EVALUATED = (
    "the absolute place of the mirror across the beam",
    "its absolute distance from the fibre",
    "its absolute spin about the beam",
    "a common turn of all moves about the beam",
)


def prediction_content(
    prediction: TaskPrediction, tolerance: float | None, task: Task, tolerances: dict[str, float] | None = None
) -> dict[str, Any]:
    """A prediction in nm and deg as JSON, null where `task` is not ok; `tolerance` in um, `tolerances` um and rad."""
    found = TaskNumbers.of(prediction, tolerance)
    content: dict[str, Any] = {
        "method": "linear" if found.linear else "draws",
        "draws": found.n_draws,
        "points": len(task),
        "points_not_ok": int((~task.ok).sum()),
        "along": task.along.tolist(),
        "along_unit": task.unit,
        "status": task.status.tolist(),
        "sd_nm": _whole(found.sd, task),
        "band_nm": {"share": BAND, "low": _whole(found.low, task), "high": _whole(found.high, task)},
        "worst_sd_nm": known(found.worst_sd),
        "peak_to_peak_nm": _peak_content(found),
        "normal_deg": dict(zip(("median", "q95"), map(known, found.normal), strict=True)),
        "turn_deg": dict(zip(("median", "q95"), map(known, found.turn), strict=True)),
        "freedoms": {
            freedom.name: _freedom_content(freedom, task) for freedom in freedom_numbers(prediction, tolerances or {})
        },
        "not_evaluated": list(NOT_EVALUATED),
        "handedness_checked": task.cell.handedness_checked,
    }
    if found.repeatable is not None and found.returned is not None:
        content["repeatable_nm"] = dict(zip(("median", "high"), found.repeatable, strict=True))
        content["return_nm"] = dict(zip(("median", "high"), found.returned, strict=True))
        without = None if prediction.without is None else 1e3 * prediction.without
        content["compensation"] = {"applied": without is not None, "median_without_nm": without}
    if tolerance is not None:
        content["tolerance_nm"] = found.tolerance
        content["exceeds_probability"] = found.exceeds
    return content


def prediction_table(predictions: list[TaskPrediction], tolerances: list[float | None], title: str) -> Table:
    """One line per task: worst sd, peak to peak with its band, angles, probability of exceeding; `tolerances` in um."""
    asked = dict.fromkeys(limit for limit in tolerances if limit is not None)
    exceeds = ["P(> tolerance)"] if len(asked) > 1 else [f"P(> {1e3 * limit:g} nm)" for limit in asked]
    heads = ["task", "path", "worst sd [nm]", "pk-pk [nm]", f"{BAND:.0%} band [nm]"]
    heads += ["normal 95 % [deg]", "turn 95 % [deg]", *exceeds]
    table = plain_table(title, heads)
    for prediction, tolerance in zip(predictions, tolerances, strict=True):
        found = TaskNumbers.of(prediction, tolerance)
        table.add_row(
            found.task.name,
            f"{found.task.along[0]:.4g} .. {found.task.along[-1]:.4g} {found.task.unit}",
            *(
                [
                    f"{found.worst_sd:.2f}",
                    f"{found.median:.2f}",
                    f"{found.least:.2f} .. {found.most:.2f}",
                    angle_text(found.normal[1]),
                    angle_text(found.turn[1]),
                ]
                if prediction.trust.usable
                else ["not to be used", *[""] * 4]
            ),
            *("" if found.exceeds is None else f"{found.exceeds:.3f}" for _ in exceeds),
        )
    return table


def mechanism_lines(predictions: list[TaskPrediction]) -> list[str]:
    """What the predictions assume of the mechanism; on a machine the repeatable part and return by themselves."""
    numbers = [TaskNumbers.of(prediction) for prediction in predictions if prediction.trust.usable]
    if all(prediction.repeatable is None for prediction in predictions):
        return ["mechanism: taken as perfect (no error motion, reversal or return error)"]
    lines = []
    for word, of in (("repeatable part", "repeatable"), ("return", "returned")):
        told = [(found.task.name, getattr(found, of)) for found in numbers if getattr(found, of) is not None]
        lines.append(f"{word}, pk-pk [nm]: " + ", ".join(f"{name} {middle:.1f}" for name, (middle, _) in told))
    gains = [
        (p.task.name, 1e3 * p.without, 1e3 * float(np.median(p.peak_to_peak)))
        for p in predictions
        if p.trust.usable and p.without is not None
    ]
    if gains:
        said = ", ".join(f"{name} {with_it:.1f} in place of {alone:.1f}" for name, alone, with_it in gains)
        lines.append(f"compensation of the known error motions, median pk-pk [nm]: {said}")
    points = dict.fromkeys(str(len(found.task)) for found in numbers)
    return [*lines, f"return errors grow with the number of points of a path, here {' or '.join(points)}"]


def freedom_table(predictions: list[TaskPrediction], along: list[float] | None = None) -> Table:
    """One line per task: upper edge of the peak to peak of each freedom since the start; `along` the beam if told."""
    heads = ["task", "along the beam [nm]", "x [nm]", "z [nm]", "rx [deg]", "ry, spin [deg]", "rz [deg]"]
    table = plain_table(
        f"Peak to peak by degree of freedom, not exceeded with {100 * (0.5 + BAND / 2):.1f} %", heads, words=(0,)
    )
    for i, prediction in enumerate(predictions):
        if not prediction.trust.usable:
            table.add_row(prediction.task.name, "not to be used", *[""] * 5)
            continue
        edges = [(found.most, found.unit) for found in freedom_numbers(prediction, {})]
        edges[0] = edges[0] if along is None else (along[i], "nm")
        told = (angle_text(most) if unit == "deg" else f"{most:.1f}" for most, unit in edges)
        table.add_row(prediction.task.name, *told)
    return table


def not_evaluated_line(cell: Cell) -> str:
    """What no prediction speaks of, and which way the axes go."""
    seen = "" if cell.handedness_checked else "; which way x and the turns go is not checked: fpcal doctor says how to"
    return f"not evaluated: {', '.join(NOT_EVALUATED)}{seen}"


def tolerance_lines(task: OwnTask, found: dict[str, float | None]) -> list[str]:
    """What is said of the tolerances of a cell's own task."""
    told = [
        f"P({name} > {np.degrees(limit):.4g} deg) = {found[name]:.3f}"
        if name.startswith("r")
        else f"P({name} > {1e3 * limit:g} nm) = {found[name]:.3f}"
        for name, limit in task.tolerances.items()
        if found[name] is not None
    ]
    return [f"task {task.name}: {', '.join(told)}"] if told else []


def _peak_content(found: TaskNumbers | FreedomNumbers) -> dict[str, Any]:
    return {"median": known(found.median), "low": known(found.least), "high": known(found.most), "share": BAND}


def _freedom_content(found: FreedomNumbers, task: Task) -> dict[str, Any]:
    unit = found.unit
    content: dict[str, Any] = {
        f"peak_to_peak_{unit}": _peak_content(found),
        "worst": {
            "along": float(task.along[task.ok][found.worst]) if found.worst_sd == found.worst_sd else None,
            f"sd_{unit}": known(found.worst_sd),
        },
        f"band_{unit}": {"share": BAND, "low": _whole(found.low, task), "high": _whole(found.high, task)},
    }
    if found.tolerance is not None:
        content |= {f"tolerance_{unit}": found.tolerance, "exceeds_probability": found.exceeds}
    return content


def reach_warnings(task: Task) -> list[str]:
    """A sentence if points of a task cannot be driven to, else nothing."""
    if task.ok.all():
        return []
    first = int(np.argmin(task.ok))
    return [
        f"task {task.name}: {int((~task.ok).sum())} of {len(task)} points cannot be driven to; point {first + 1}: "
        f"{task.status[first]}"
    ]


def angle_text(angle: float) -> str:
    """An angle in deg; what rounding leaves is nothing."""
    return f"{angle:.2g}" if angle > 1e-9 else "0"


def _whole(driven: Floats, task: Task) -> list[float | None]:
    """Numbers of the points that are ok, with nothing in the place of the others."""
    numbers = iter(driven.tolist())
    return [known(next(numbers)) if good else None for good in task.ok]


def known(value: float) -> float | None:
    """A number as JSON has it: NaN is nothing."""
    return None if value != value else value


def budget_content(budget: Budget) -> dict[str, Any]:
    """A budget as JSON; contributions and results in nm."""
    return {
        "freedom": "beam",
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
    """One line per input, with its share where the inputs are independent, then what they combine to."""
    shares = variance_shares(budget)
    heads = ["input", "type", "distribution", "estimate", "std. uncertainty", "sensitivity [nm]", "contribution [nm]"]
    title = f"Uncertainty budget of {budget.task} along the beam at {budget.along:.4g} {budget.unit}: change of cavity "
    title += "length since aligned"
    table = plain_table(title, [*heads, *([] if shares is None else ["share of the variance"])], words=(0, 1, 2))
    for i, line in enumerate(budget.lines):
        table.add_row(
            line.name,
            line.evaluation,
            line.distribution,
            f"{line.estimate:g}",
            f"{line.standard_uncertainty:.3g} {line.unit}",
            # What is zero but for rounding is zero.
            f"{round(1e3 * line.sensitivity, 9):.3g} / {line.unit}",
            f"{round(1e3 * line.contribution, 9):.3g}",
            *([] if shares is None else [f"{100 * shares[i]:.1f} %"]),
        )
    low, high = budget.interval
    none = [""] * (len(table.columns) - 7)
    table.add_row("combined standard uncertainty", *[""] * 5, f"{1e3 * budget.combined:.3g}", *none)
    table.add_row(f"{COVERAGE:.0%} coverage interval", *[""] * 5, f"{1e3 * low:.3g} .. {1e3 * high:.3g}", *none)
    return table


def correlation_lines(budget: Budget) -> list[str]:
    """One line per pair of inputs whose contributions are correlated."""
    return [f"correlation of {one} with {other}: {size:+.3f}" for one, other, size in correlated_inputs(budget)]
