"""Tables for the terminal."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.markup import escape
from rich.table import Table

from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet

#: Colour of each status.
STATUS_STYLES = {"identified": "green", "weak": "yellow", "gauge": "red", "fixed": "dim"}


def plain_table(title: str, columns: Sequence[str]) -> Table:
    """An empty table; the first two columns hold text, the others numbers."""
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i < 2 else "right", no_wrap=True)
    return table


def number(value: float, sd: float) -> str:
    """Write a value with two significant digits of its standard deviation (at most six decimals)."""
    if not np.isfinite(sd) or sd <= 0:
        return f"{value:.6g}"
    decimals = int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))
    # Adding zero turns -0 into 0.
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def parameter_table(estimate: Estimate, title: str) -> Table:
    """Value, standard deviation, prior and status of each parameter."""
    table = plain_table(title, ["parameter", "unit", "value", "sd", "prior sd", "status"])
    shown = estimate.shown()
    for parameter, status in zip(estimate.parameters, estimate.status, strict=True):
        value, sd = shown[parameter.name]["value"], shown[parameter.name]["sd"]
        style = STATUS_STYLES[status]
        table.add_row(
            parameter.name,
            parameter.unit,
            number(value, sd),
            number(sd, sd) if sd > 0 else "exact",
            f"{parameter.shown(parameter.prior_sd):g}",
            f"[{style}]{status}[/{style}]",
        )
    return table


def truth_table(estimate: Estimate, truth: NDArray[np.float64], names: Sequence[str], title: str) -> Table:
    """Identified values beside the truth of a simulated cell.

    Parameters
    ----------
    truth
        Of the parameters `names`, in um and rad, shape (n,).
    """
    table = plain_table(title, ["parameter", "unit", "truth", "identified", "sd", "error / sd", "status"])
    shown = estimate.shown()
    for name, true in zip(names, truth, strict=True):
        parameter = estimate.cell.parameters[name]
        value, sd = shown[name]["value"], shown[name]["sd"]
        status = estimate.status[estimate.parameters.position(name)]
        style = STATUS_STYLES[status]
        table.add_row(
            name,
            parameter.unit,
            f"{parameter.shown(float(true)):.6g}",
            number(value, sd),
            number(sd, sd) if sd > 0 else "exact",
            f"{(value - parameter.shown(float(true))) / sd:+.1f}" if sd > 0 else "",
            f"[{style}]{status}[/{style}]",
        )
    return table


def reflection_lines(estimate: Estimate, true_parameters: ParameterSet, truth: NDArray[np.float64]) -> list[str]:
    """The reflection point at joint vector zero, in the world and in the mirror frame, beside the truth.

    Parameters
    ----------
    true_parameters, truth
        Parameters of the truth and their values in um and rad, shape (n,).
    """
    cell = estimate.cell
    model = CavityModel.of(cell, estimate.parameters)
    origin = np.zeros((1, len(cell.joints)))
    world, mirror = model.reflection_points(estimate.values, origin)
    world_sd, mirror_sd = model.reflection_sd(estimate.values, estimate.covariance, origin[0])
    true_world, true_mirror = CavityModel.of(cell, true_parameters).reflection_points(truth, origin)

    def line(name: str, found: NDArray[np.float64], sd: NDArray[np.float64], true: NDArray[np.float64]) -> str:
        parts = (
            f"{axis} {number(f, s)} +- {number(s, s)} (truth {t:.1f})"
            for axis, f, s, t in zip("xyz", found, sd, true, strict=False)
        )
        return f"{name} at q = 0 [um]: " + ", ".join(parts)

    return [
        line("reflection point wPr", world[0], world_sd, true_world[0]),
        line("reflection point tPr", mirror[0][:2], mirror_sd[:2], true_mirror[0][:2]),
    ]


def fit_lines(result: Identification, *, timed: bool = True) -> list[str]:
    """What a reader of an identification needs to know about the fit; `timed` adds how long it took."""
    fit = result.fit
    state = "converged" if result.converged else "NOT CONVERGED"
    lines = [
        f"fit: {state}, sum of squares {result.solution.sum_of_squares:.2f} over {len(result.problem.sweeps)} rows and "
        f"the prior; chi-square of the data {fit.chi2_data:.1f}, expected {fit.expected:.1f} (p = {fit.p_value:.2g})",
        f"rank: {result.spectrum.rank} of {len(result.free)} combinations of the free parameters are seen by the data",
        "largest residuals: " + ", ".join(f"{label} {value:+.1f} sd" for label, value in result.largest_residuals()),
    ]
    unsigned = int((~result.problem.sweeps.signed).sum())
    if unsigned:
        lines.append(f"signs: {unsigned} decided with the fit, {len(result.doubtful_signs)} of them doubtful")
    if timed:
        lines.append(f"time: {1e3 * result.seconds:.0f} ms")
    return lines
