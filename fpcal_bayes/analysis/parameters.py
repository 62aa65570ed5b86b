"""The numbers that are shown of parameters: what draws say of each, and how far an estimate is from a known truth."""

from typing import Any

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.netcdf import PosteriorSummary
from fpcal_bayes.infer.posterior.netcdf import summarise as summarise
from fpcal_bayes.model.estimate import Estimate


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
