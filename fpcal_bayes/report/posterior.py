"""A posterior as a table and as densities, and a model comparison."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.analysis.files import summarise
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.compare import Comparison, ModelResult
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.netcdf import PosteriorSummary
from fpcal_bayes.report.pages import BLUE, VERMILION
from fpcal_bayes.report.table import Table, number, plain_table

#: Draws that a density is made of at most, evenly spaced ones of longer runs.
_SHOWN_DRAWS = 1000
_N_COLUMNS = 4


def prior_posterior_figure(names: Sequence[str], draws: Floats, before: Floats) -> Figure:
    """Densities of draws and of prior draws `before`, (n, n_names), over what the draws cover."""
    # ArviZ takes seconds to import: only figures pay for it.
    from arviz_stats.base import array_stats

    rows = -(-len(names) // _N_COLUMNS)
    figure = Figure(figsize=(11.0, 0.5 + 1.9 * rows), layout="constrained")
    axes = figure.subplots(rows, _N_COLUMNS, squeeze=False).ravel()
    for axis, name, own, prior in zip(axes, names, draws.T, before.T, strict=False):
        styles = {"prior": (prior, VERMILION, "--"), "posterior": (own, BLUE, "-")}
        for label, (values, colour, style) in styles.items():
            grid, density, _ = array_stats.kde(values[:: -(-values.size // _SHOWN_DRAWS)], grid_len=200)
            axis.plot(grid, density, style, color=colour, linewidth=1.4, label=label)
        low, high = np.quantile(own, [0.002, 0.998])
        axis.set_xlim(low - 0.2 * (high - low), high + 0.2 * (high - low))
        axis.set_xlabel(name)
        axis.set_yticks([])
        axis.grid(alpha=0.3)
    for axis in axes[len(names) :]:
        axis.remove()
    figure.supylabel("density", fontsize="medium")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


def posterior_table(posterior: Posterior | PosteriorSummary, title: str) -> Table:
    """Mean, standard deviation and interval of each parameter, with what the draws are worth."""
    parameters = posterior.identification.free if isinstance(posterior, Posterior) else posterior.parameters
    columns = ["parameter", "unit", "mean", "sd", "5 %", "50 %", "95 %", "ess bulk", "ess tail", "R-hat"]
    table = plain_table(title, columns)
    for name, found in summarise(posterior).items():
        shown = [number(found[key], found["sd"]) for key in ("mean", "sd", "q05", "q50", "q95")]
        worth = [f"{found['ess_bulk']:.0f}", f"{found['ess_tail']:.0f}", f"{found['rhat']:.4f}"]
        table.add_row(name, parameters[name].unit, *shown, *worth)
    return table


def compare_table(comparison: Comparison, title: str) -> Table:
    """Fit and leave-one-out prediction of each model."""
    columns = ["model", "fit", "chi-square", "expected", "p", "elpd", "se", "p_loo", "bad k", "refits"]
    table = plain_table(title, columns)
    for model in comparison.models:
        fit = model.identification.fit
        numbers = [f"{fit.chi2_data:.1f}", f"{fit.expected:.1f}", f"{fit.p_value:.1g}"]
        table.add_row(model.spec.name, _fit_words(model), *numbers, *_predictions(model))
    return table


def _fit_words(model: ModelResult) -> str:
    if model.state == "no minimum":
        return "no minimum"
    return "poor" if model.poor else "good" if model.spec.likelihood == "gaussian" else "not judged"


def _predictions(model: ModelResult) -> list[str]:
    loo = model.loo
    if loo is None:
        return ["-"] * 5
    sizes = [number(loo.elpd, loo.se), number(loo.se, loo.se), f"{loo.p_loo:.1f}"]
    return [*sizes, str(int(loo.bad.sum())), str(int(loo.refitted.sum()))]
