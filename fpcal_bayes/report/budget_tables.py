"""Uncertainty budgets as tables and as JSON."""

from typing import Any

from rich.markup import escape
from rich.table import Table

from fpcal_bayes.infer.budget import COVERAGE, Budget
from fpcal_bayes.report.tables import plain_table


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
