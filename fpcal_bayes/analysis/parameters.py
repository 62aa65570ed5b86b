"""The numbers that are shown of parameters: what draws say of each, and how far an estimate is from a known truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.netcdf import PosteriorSummary, summarise
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet


@dataclass(frozen=True)
class DrawnParameter:
    """What draws say of a parameter, in the units a person reads, and what they are worth."""

    name: str
    unit: str
    mean: float
    sd: float
    low: float  # edges of a central interval
    median: float
    high: float
    ess_bulk: float
    ess_tail: float
    rhat: float


def sampled_parameters(posterior: Posterior) -> list[DrawnParameter]:
    """Summary of a posterior in memory, with 90 % intervals."""
    free = posterior.identification.free
    keys = ("mean", "sd", "q05", "q50", "q95", "ess_bulk", "ess_tail", "rhat")
    found = summarise(posterior).items()
    return [DrawnParameter(name, free[name].unit, *(entry[key] for key in keys)) for name, entry in found]


def saved_parameters(posterior: PosteriorSummary) -> list[DrawnParameter]:
    """Summary of a posterior file, with 95 % intervals."""
    flat = posterior.draws.reshape(-1, len(posterior.parameters))
    found = []
    for i, parameter in enumerate(posterior.parameters):
        values = flat[:, i]
        edges = (float(q) for q in np.quantile(values, [0.025, 0.5, 0.975]))
        worth = (float(each[i]) for each in (posterior.ess_bulk, posterior.ess_tail, posterior.rhat))
        mean, sd = float(values.mean()), float(values.std(ddof=1))
        found.append(DrawnParameter(parameter.name, parameter.unit, mean, sd, *edges, *worth))
    return found


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
