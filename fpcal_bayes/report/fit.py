"""The parameters of an estimate as a table, and what a reader needs to know of its fit."""

from fpcal_bayes.core.linalg import chance, plain
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.report.table import Table, TableCell, number, plain_table


def parameter_table(estimate: Estimate, title: str) -> Table:
    """Value, standard deviation, prior and status of each parameter."""
    table = plain_table(title, ["parameter", "unit", "value", "sd", "prior sd", "status"])
    shown = estimate.shown()
    for parameter, status in zip(estimate.parameters, estimate.status, strict=True):
        value, sd = shown[parameter.name]["value"], shown[parameter.name]["sd"]
        table.add_row(
            parameter.name,
            parameter.unit,
            number(value, sd),
            number(sd, sd) if sd > 0 else "exact",
            f"{parameter.shown(parameter.prior_sd):g}",
            TableCell(status, style=status),
        )
    return table


def fit_lines(result: Identification, *, timed: bool = True) -> list[str]:
    """What a reader of an identification needs to know about the fit; `timed` adds how long it took."""
    fit = result.fit
    state = "converged" if result.converged else "NOT CONVERGED"
    rows = len(result.problem.sweeps)
    lines = [
        f"fit: {state}, sum of squares {plain(result.solution.sum_of_squares, 2)} over {rows} rows "
        f"and the prior; chi-square of the data {plain(fit.chi2_data)}, expected {fit.expected:.1f} "
        f"({chance(fit.p_value)})",
        f"rank: {result.spectrum.rank} of {len(result.free)} combinations of the free parameters are seen by the data",
        "largest residuals: " + ", ".join(f"{label} {value:+.3g} sd" for label, value in result.largest_residuals()),
    ]
    if result.undetermined:
        lines.insert(2, f"along the others the estimate is the prior: {', '.join(result.undetermined)}")
    unsigned = int((~result.problem.sweeps.signed).sum())
    if unsigned:
        lines.append(f"signs: {unsigned} decided with the fit, {len(result.doubtful_signs)} of them doubtful")
    if timed:
        lines.append(f"time: {1e3 * result.seconds:.0f} ms")
    return lines
