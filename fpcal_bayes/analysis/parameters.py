"""The numbers that are shown of parameters: what draws say of each, and how far an estimate is from a known truth."""

from typing import Any

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.netcdf import PosteriorSummary
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet


def drawn_quantiles(posterior: PosteriorSummary) -> Floats:
    """Standard deviation, median and ends of 95 % of the draws of each parameter, (4, n), as a person reads them."""
    values = posterior.draws.reshape(-1, len(posterior.parameters))
    return np.vstack([values.std(axis=0, ddof=1), np.quantile(values, [0.5, 0.025, 0.975], axis=0)])


def intervals(posterior: PosteriorSummary, estimate: Estimate) -> dict[str, Floats]:
    """Lower end, middle and upper end of 95 % intervals, from nominal in prior sds, each of shape (3, n)."""
    parameters = posterior.parameters
    scale, centre = parameters.to_shown(parameters.prior_sd), parameters.to_shown(parameters.nominal)
    shown = estimate.shown()
    laplace = np.array([(shown[p.name]["value"], shown[p.name]["sd"]) for p in parameters])
    values, sds = (laplace[:, 0] - centre) / scale, laplace[:, 1] / scale
    draws = (posterior.draws.reshape(-1, len(parameters)) - centre) / scale
    prior = (posterior.prior - centre) / scale
    return {
        "prior": np.quantile(prior, [0.025, 0.5, 0.975], axis=0),
        "normal approximation": np.array([values - 1.96 * sds, values, values + 1.96 * sds]),
        "posterior draws": np.quantile(draws, [0.025, 0.5, 0.975], axis=0),
    }


def tree_draws(tree: Any, group: str = "posterior") -> tuple[list[str], Floats]:
    """Names and draws of the cell's parameters in a DataTree of `data_tree`, shape (n, n_chains, n_draws)."""
    # What belongs to the likelihood has no prior in the tree.
    names = [str(name) for name in tree["prior"].data_vars]
    return names, np.array([tree[group][name].transpose("chain", "draw").to_numpy() for name in names])


def most_correlated(tree: Any, n: int) -> list[str]:
    """Names of `n` parameters that take part in the largest correlations, in the order of the tree."""
    names, draws = tree_draws(tree)
    if len(names) <= n:
        return names
    size = np.abs(np.corrcoef(draws.reshape(len(names), -1)))
    first, second = np.triu_indices(len(names), 1)
    chosen: list[int] = []
    for k in np.argsort(-size[first, second], kind="stable"):
        new = [int(i) for i in (first[k], second[k]) if i not in chosen]
        chosen += new[: n - len(chosen)]
        if len(chosen) == n:
            break
    return [names[i] for i in sorted(chosen)]


def ensemble_draws(tree: Any, fewest: int, most: int) -> tuple[list[str], Floats]:
    """Names, and as many draws of each ensemble as it is worth, shape (n, n_ensembles, n_draws)."""
    # ArviZ takes seconds to import: only figures pay for it.
    from arviz_stats.base import array_stats

    names, draws = tree_draws(tree)
    n_ensembles = int(tree.attrs["n_ensembles"])
    # The walkers of an ensemble together are one chain, as in the nested R-hat.
    ensembles = draws.reshape(len(names), n_ensembles, -1)
    effective = float(np.min(array_stats.ess(draws, chain_axis=1, draw_axis=2))) / n_ensembles
    return names, ensembles[:, :, :: -(-ensembles.shape[2] // int(np.clip(effective, fewest, most)))]


def predictive_residuals(tree: Any) -> tuple[list[str], Floats]:
    """Names of the rows, and measured less predicted in standard deviations of the prediction, shape (n_rows,)."""
    observed, predicted = tree["observed_data"]["dl_um"], tree["posterior_predictive"]["dl_um"]
    residuals = (observed - predicted.mean(("chain", "draw"))) / predicted.std(("chain", "draw"))
    return [str(label) for label in observed["sweep"].to_numpy()], residuals.to_numpy()


def reflection_points(
    estimate: Estimate, parameters: ParameterSet, truth: Floats
) -> dict[str, tuple[Floats, Floats, Floats]]:
    """The reflection point at joint vector zero, its sd and its truth, um: in the world (3,), in the mirror frame (2,).

    `truth` holds values of `parameters` in um and rad, shape (n,).
    """
    cell = estimate.cell
    model = CavityModel.of(cell, estimate.parameters)
    home = np.zeros((1, len(cell.joints)))
    found = model.reflection_points(estimate.values, home)
    sds = model.reflection_sd(estimate.values, estimate.covariance, home[0])
    trues = CavityModel.of(cell, parameters).reflection_points(truth, home)
    return {"wPr": (found[0][0], sds[0], trues[0][0]), "tPr": (found[1][0][:2], sds[1][:2], trues[1][0][:2])}
