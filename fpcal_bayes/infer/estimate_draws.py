"""Posterior draws that an estimate hands on beside its covariance.

The posterior is curved, and may have a second minimum (see `mirror`): of 95 % bands from the covariance alone 91 %
(spin) to 95 % hold after the paper's end-point sweeps, and of those of a spin 73 % where there is a second minimum. A
few hundred draws of the charts around the minima, weighted by the posterior and drawn again by weight, take a tenth of
a second and hold 94 to 95 % (studies/task_coverage.py).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.files import read_text
from fpcal_bayes.infer.identify import Identification
from fpcal_bayes.infer.posterior.atlas import Atlas
from fpcal_bayes.infer.posterior_file import PosteriorDraws
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet

Floats = NDArray[np.float64]

N_DRAWS = 500
#: Further draws are made until they are worth this share of those wanted, at most so many times.
_LEAST_WORTH = 0.5
_MOST_ROUNDS = 8
#: Digits kept after the point, in um and deg: a hundredth of a picometre on a task.
_DIGITS = 10


def independent_draws(found: Identification, draws: int = N_DRAWS, seed: int = 0) -> Floats:
    """Draws of the posterior around all of its minima.

    Parameters
    ----------
    found
        Its minima are the reference points of the charts.
    draws, seed
        How many, and the seed of numpy's default generator.

    Returns
    -------
    ndarray
        Free parameters in um and rad, shape (draws, n_free). Points that the charts propose too rarely stand in it more
        than once. None, shape (0, n_free), where the charts do not tell enough of the posterior, as of a poor fit.
    """
    # The sampler brings emcee, which takes half a second to import.
    from fpcal_bayes.infer.posterior.sample import make_target

    target, references = make_target(found, "gaussian")
    atlas, random = Atlas(target, references), np.random.default_rng(seed)
    points, log_weights = np.zeros((0, target.n_unknowns)), np.zeros(0)
    for _ in range(_MOST_ROUNDS):
        solved = atlas.propose(random.standard_normal((draws, target.n_unknowns)), random.random(draws))
        points = np.vstack([points, solved.points[solved.inside]])
        fresh = solved.log_density[solved.inside] - solved.log_proposal[solved.inside]
        log_weights = np.concatenate([log_weights, fresh])
        weights = np.exp(log_weights - log_weights.max()) if len(log_weights) else np.zeros(1)
        worth = float(weights.sum() ** 2 / max(float((weights**2).sum()), 1e-300))
        if worth >= _LEAST_WORTH * draws:
            break
    else:
        return np.zeros((0, found.problem.n_free))
    # Systematic resampling: each point as often as its weight says, up to rounding.
    places = (np.arange(draws) + random.random()) / draws
    chosen = np.searchsorted(np.cumsum(weights) / weights.sum(), places)
    values: Floats = found.problem.values(points[np.minimum(chosen, len(points) - 1)])
    return values


def draws_content(found: Identification, draws: int = N_DRAWS) -> dict[str, Any]:
    """Draws as JSON, in um and deg: names and one row a draw; empty where the covariance has to do.

    That is so if the fit did not converge or is so poor that the charts fail, or parameters are held: draws would let
    the data speak about these.
    """
    free = found.problem.model.free
    if not found.converged or free.names != found.estimate.parameters.names:
        return {}
    values = independent_draws(found, draws)
    if not len(values):
        return {}
    shown = np.round(free.to_shown(values), _DIGITS)
    return {"draws": {"names": list(free.names), "rows": shown.tolist()}}


def read_estimate_draws(path: str | Path, cell: Cell) -> PosteriorDraws | None:
    """Draws in an estimate file that `read_estimate` has accepted, or None if it holds none.

    Raises
    ------
    InputError
        If they are not rows of finite numbers, one for each parameter of the file.
    """
    content = json.loads(read_text(Path(path)))
    stated = content.get("draws")
    if stated is None:
        return None
    parameters = ParameterSet(p for p in cell.parameters if p.name in content["parameters"])
    if not isinstance(stated, dict) or stated.get("names") != list(parameters.names):
        raise InputError(f"{path}: key draws.names: expected the parameters above, in this order")
    try:
        rows = np.array(stated.get("rows"), dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: key draws.rows: expected rows of {len(parameters)} numbers") from error
    if rows.ndim != 2 or rows.shape[1] != len(parameters) or not len(rows) or not np.isfinite(rows).all():
        raise InputError(f"{path}: key draws.rows: expected rows of {len(parameters)} finite numbers, one or more")
    return PosteriorDraws(cell, parameters, parameters.to_internal(rows))
