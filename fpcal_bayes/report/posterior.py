"""A posterior as a table and as figures (ranks, prior, pairs, residuals, Pareto k), and a model comparison."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fpcal_bayes.analysis.parameters import ensemble_draws, most_correlated, predictive_residuals, tree_draws
from fpcal_bayes.core.files import make_folder
from fpcal_bayes.infer.posterior.compare import Comparison, ModelResult
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.leave_out import LeaveOneOut
from fpcal_bayes.infer.posterior.netcdf import summarise
from fpcal_bayes.report.pages import BLUE, GREEN, GREY, ORANGE, VERMILION, save_figure
from fpcal_bayes.report.table import Table, number, plain_table

# ArviZ, corner, xarray and pyplot are imported in functions: they take seconds, and only figures pay for them.

_SETTINGS: dict[Any, Any] = {
    "axes.prop_cycle": cycler(color=[BLUE, ORANGE, GREEN, VERMILION]),
    "axes.axisbelow": True,
    "font.size": 9,
}
#: Draws that a figure shows at most, of an ensemble or altogether; evenly spaced ones of longer runs.
_SHOWN_DRAWS, _FEWEST_DRAWS = 500, 20
_PAIR_DRAWS = 8000
_CHOSEN_PAIRS = 5
_MOST_LABELS = 80
_N_COLUMNS = 4


def write_posterior_figures(
    tree: Any, loo: LeaveOneOut, folder: Path, *, pairs: Sequence[str] | None = None
) -> list[Path]:
    """Draw a posterior: ranks, prior against posterior, pairs, residuals, Pareto k.

    tree: dataTree as `fpcal_bayes.infer.posterior.netcdf.data_tree` builds it.
    loo: leave-one-out of the same posterior.
    folder: made if it is not there; files of the same names are replaced.
    pairs: parameters of the pair plot; by default the most correlated ones.
    """
    make_folder(folder)
    names = most_correlated(tree, _CHOSEN_PAIRS) if pairs is None else list(pairs)
    with off_screen():
        drawn = {
            "ranks": rank_figure(tree),
            "prior-posterior": prior_posterior_figure(tree),
            "residuals": residual_figure(tree),
            "pareto-k": pareto_k_figure(tree, loo),
        }
        if len(names) > 1:
            drawn["pairs"] = pair_figure(tree, names)
        for name, figure in drawn.items():
            save_figure(figure, folder / f"{name}.png")
    return [folder / f"{name}.png" for name in drawn]


def rank_figure(tree: Any) -> Figure:
    """Distribution of the ranks of each ensemble's draws among all draws, less the uniform one."""
    import arviz as az
    import arviz_plots as azp

    # The test in each panel is for independent draws: of each ensemble as many are ranked as it is worth.
    names, ensembles = ensemble_draws(tree, _FEWEST_DRAWS, _SHOWN_DRAWS)
    n_ensembles = ensembles.shape[1]
    plot = azp.plot_rank(
        az.from_dict({"posterior": dict(zip(names, ensembles, strict=True))}),
        backend="matplotlib",
        visuals={"title": False, "xlabel": False, "remove_axis": False},
        **_layout(len(names), sharex=False, sharey=True),
    )
    figure: Figure = plot.get_viz("figure")
    for i, name in enumerate(names):
        axis = plot.get_viz("plot", name)
        axis.set_title(name, fontsize=9)
        axis.axhline(0.0, color=GREY, linewidth=0.8)
        axis.tick_params(labelbottom=True)
        axis.set_xlabel("rank / number of draws [1]")
        if i % _N_COLUMNS == 0:
            axis.set_ylabel("share of draws\nabove uniform [1]")
    handles = [Line2D([], [], color=f"C{i}", label=f"ensemble {i + 1}") for i in range(n_ensembles)]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    return figure


def prior_posterior_figure(tree: Any) -> Figure:
    """Densities of prior and posterior over what the posterior covers; a far wider prior lies flat."""
    import arviz as az
    import arviz_plots as azp

    styles: dict[str, tuple[str, Literal["--", "-"]]] = {"prior": (VERMILION, "--"), "posterior": (BLUE, "-")}
    names, draws = tree_draws(tree)
    _, prior = tree_draws(tree, "prior")
    every = -(-draws[0].size // (2 * _SHOWN_DRAWS))
    groups = {
        group: dict(zip(names, drawn.reshape(len(names), 1, -1)[:, :, ::every], strict=True))
        for group, drawn in (("posterior", draws), ("prior", prior))
    }
    plot = azp.plot_prior_posterior(
        az.from_dict(groups),
        var_names=names,
        kind="kde",
        backend="matplotlib",
        visuals={"title": False, "remove_axis": False},
        **_layout(len(names)),
    )
    figure: Figure = plot.get_viz("figure")
    for i, name in enumerate(names):
        axis = plot.get_viz("plot", name)
        for line, (colour, style) in zip(axis.lines, styles.values(), strict=True):
            line.set(color=colour, linestyle=style, linewidth=1.4)
        low, high = np.quantile(groups["posterior"][name], [0.002, 0.998])
        axis.set_xlim(low - 0.2 * (high - low), high + 0.2 * (high - low))
        axis.set_xlabel(_label(tree, name))
        axis.set_yticks([])
        axis.grid(alpha=0.3)
        if i % _N_COLUMNS == 0:
            axis.set_ylabel("density")
    # The legend of arviz-plots knows one colour a group only, and takes a column of the page.
    for legend in list(figure.legends):
        legend.remove()
    handles = [Line2D([], [], color=colour, linestyle=style) for colour, style in styles.values()]
    figure.legend(handles, list(styles), loc="outside upper center", ncols=2, frameon=False)
    return figure


def pair_figure(tree: Any, names: Sequence[str]) -> Figure:
    """Draws of each pair of some parameters."""
    import corner

    known, draws = tree_draws(tree)
    flat = draws.reshape(len(known), -1)
    chosen = flat[[known.index(name) for name in names], :: -(-flat.shape[1] // _PAIR_DRAWS)]
    side = 1.0 + 1.7 * len(names)
    figure = Figure(figsize=(side, side))
    corner.corner(
        chosen.T,
        labels=[_label(tree, name) for name in names],
        fig=figure,
        color=BLUE,
        bins=30,
        max_n_ticks=4,
        # Of a two-dimensional normal distribution: 50 % and 90 % of the draws.
        levels=(0.5, 0.9),
        label_kwargs={"fontsize": 9},
        labelpad=0.1,
    )
    # Room for the labels, an inch on either side.
    figure.subplots_adjust(left=1.0 / side, bottom=1.0 / side)
    return figure


def residual_figure(tree: Any) -> Figure:
    """What was measured of each row, against what the posterior predicts, in standard deviations of the prediction."""
    labels, residuals = predictive_residuals(tree)
    n = len(residuals)
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    axis = figure.subplots()
    axis.axhspan(-1.96, 1.96, color=BLUE, alpha=0.12, linewidth=0, label="95 % of what is predicted")
    axis.axhspan(-0.674, 0.674, color=BLUE, alpha=0.22, linewidth=0, label="50 %")
    axis.axhline(0.0, color=GREY, linewidth=0.8)
    outside = np.abs(residuals) > 1.96
    place = np.arange(n)
    axis.plot(place[~outside], residuals[~outside], "o", color="black", markersize=3.5, label="measured")
    if outside.any():
        axis.plot(place[outside], residuals[outside], "D", color=VERMILION, markersize=4.5, label="measured, outside")
    axis.set_xlim(-1, n)
    _label_rows(axis, labels)
    axis.set_ylabel("measured less predicted\n[sd of the prediction]")
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure


def pareto_k_figure(tree: Any, loo: LeaveOneOut) -> Figure:
    """Shape of the tail of the leave-one-out weights of each row, with the limit of what can be trusted."""
    import arviz_plots as azp
    import xarray as xr
    from arviz_stats import ELPDData

    labels = [str(label) for label in tree["observed_data"]["sweep"].to_numpy()]
    n = len(labels)
    data = ELPDData(
        elpd=loo.elpd,
        se=loo.se,
        p=loo.p_loo,
        n_samples=0,
        n_data_points=n,
        scale="log",
        warning=bool(loo.bad.any()),
        good_k=loo.good_k,
        pareto_k=xr.DataArray(loo.pareto_k, dims=["sweep"], coords={"sweep": np.arange(n)}),
    )
    plot = azp.plot_khat(
        data,
        color=BLUE,
        backend="matplotlib",
        visuals={"hlines": False, "bin_text": False, "xlabel": False, "ylabel": False, "title": False, "ticks": False},
        figure_kwargs={"figsize": (10.0, 4.2), "layout": "constrained"},
    )
    figure: Figure = plot.get_viz("figure")
    axis = figure.axes[0]
    for row in np.flatnonzero(loo.bad).tolist():
        axis.annotate(labels[row], (row, loo.pareto_k[row]), (3, 3), textcoords="offset points", fontsize=8)
    axis.axhline(loo.good_k, color=VERMILION, linestyle="--", linewidth=1.2, label=f"trusted up to {loo.good_k:.2f}")
    axis.set_xlim(-1, n)
    axis.set_ylim(top=max(1.1 * loo.good_k, 1.1 * float(np.nanmax(loo.pareto_k))))
    _label_rows(axis, labels)
    axis.set_ylabel("Pareto k of leaving\nthe row out [1]")
    figure.legend(loc="outside upper center", frameon=False)
    return figure


def _label(tree: Any, name: str) -> str:
    return f"{name} [{tree['posterior'][name].attrs['units']}]"


def _layout(n: int, **shared: bool) -> dict[str, Any]:
    """Panels of `n` parameters."""
    size = (11.0, 0.5 + 1.9 * -(-n // _N_COLUMNS))
    return {"col_wrap": _N_COLUMNS, "figure_kwargs": {"figsize": size, "layout": "constrained", **shared}}


def _label_rows(axis: Any, labels: list[str]) -> None:
    if len(labels) <= _MOST_LABELS:
        axis.set_xticks(np.arange(len(labels)), labels, rotation=90, fontsize=7, parse_math=False)
    axis.set_xlabel("sweep, in order of measurement")
    axis.grid(axis="y", alpha=0.3)


@contextmanager
def off_screen() -> Iterator[None]:
    """Draw into memory, with settings that end with the block: arviz-plots draws through pyplot."""
    import matplotlib.pyplot as plt

    before = matplotlib.get_backend(auto_select=False)
    known = set(plt.get_fignums())
    plt.switch_backend("agg")
    try:
        with matplotlib.rc_context(_SETTINGS):
            yield
    finally:
        for number in set(plt.get_fignums()) - known:
            plt.close(number)
        if before is not None:
            plt.switch_backend(before)


def posterior_table(posterior: Posterior, title: str) -> Table:
    """Mean, standard deviation and interval of each parameter, with what the draws are worth."""
    columns = ["parameter", "unit", "mean", "sd", "5 %", "50 %", "95 %", "ess bulk", "ess tail", "R-hat"]
    table = plain_table(title, columns)
    for name, found in summarise(posterior).items():
        shown = [number(found[key], found["sd"]) for key in ("mean", "sd", "q05", "q50", "q95")]
        worth = [f"{found['ess_bulk']:.0f}", f"{found['ess_tail']:.0f}", f"{found['rhat']:.4f}"]
        table.add_row(name, posterior.identification.free[name].unit, *shown, *worth)
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
