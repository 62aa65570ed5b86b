"""Where the filter starts, and what a drift does beyond its stated size.

The geometry through which a drift acts is not exactly known. After a calibration some combinations of the parameters
are known to about a degree only: nothing measured then depends on them. What a later drift does to the cavity length
does depend on them, by a share of about that angle. The part of the drift that sessions find is carried by the state
itself, whose covariance is seen through the derivatives at the new mean. The part that is not yet found acts through
derivatives J(x) at an unknown x, and not through J(m):

    J(x) dx = J(m) T(x) dx,    T(x) = J(m)^+ J(x),

so that the covariance of T(x) dx over x ~ N(m, P) and dx ~ N(0, Q) is, to first order in x - m,

    Q + sum over columns s of the root of P of B(s) Q B(s)',    B(s) = T(m + s) - 1.

The sum is the mixed term of a second-order filter (Jazwinski 1970, section 9.3). Its other terms, of P with itself,
are no part of it: the start of the filter holds them (see `linear_start`), and later sessions are linearised where they
lead (see `smoother`).
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.candidates import candidate_sweeps
from fpcal_bayes.measure.protocol import seen_by_all
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.tracking.drift import DriftModel, State

#: Random sweeps that stand for what will be asked of the model, and the weight of each, as its sigma in um.
N_SWEEPS, SIGMA = 200, 0.005
#: Added variance of each direction, as a share of the prior's: rounding.
_JITTER = 1e-18


def linear_start(estimate: Estimate, draws: Floats, sweeps: Sweeps) -> Estimate:
    """The maximum of the posterior, with the covariance by which its linear predictions spread as `draws` do."""
    parameters = estimate.parameters
    model = CavityModel.of(estimate.cell, parameters, estimate.vector())
    sd = parameters.prior_sd
    random = seen_by_all(candidate_sweeps(estimate.cell, n=N_SWEEPS, rng=np.random.default_rng(0)), estimate.cell)
    # Where no row tells a direction, the parameters themselves do: one row each, of their prior's size.
    jacobians, changes = [np.eye(len(sd))], [(draws - estimate.values) / sd]
    for asked in (random, sweeps.take(sweeps.kind != "path")):
        rows = asked.laid_out(model)
        predicted, jacobian = model.predict_with_jacobian(estimate.values, rows)
        jacobians.append(jacobian * sd / SIGMA)
        changes.append((model.predict(draws, rows) - predicted) / SIGMA)
    moved = np.linalg.lstsq(np.vstack(jacobians), np.hstack(changes).T, rcond=None)[0].T
    return replace(estimate, covariance=(moved.T @ moved / len(moved) + _JITTER * np.eye(len(sd))) * np.outer(sd, sd))


#: Combinations known better than this, in prior standard deviations, turn the geometry by nothing that matters.
_LEAST_SD = 1e-3


def with_hidden_noise(drift: DriftModel, model: CavityModel, state: State) -> DriftModel:
    """The drift with the noise that an uncertain geometry adds (`hidden`), by the state after the calibration."""
    n = drift.n_parameters
    known = (state.mean[:n].tobytes(), state.covariance[:n, :n].tobytes())
    try:
        turns = _turns(model.cell, model.free, model.held.tobytes(), (model.side, model.sides), *known)
    except InputError:
        return drift
    hidden = np.zeros((n, n))
    for turn in turns:
        turned = turn * drift.walk
        hidden += turned @ turned.T
    return replace(drift, hidden=hidden)


@lru_cache(maxsize=8)
def _turns(
    cell: Cell, free: ParameterSet, held: bytes, sides: tuple[int, tuple[int, ...]], mean: bytes, covariance: bytes
) -> list[Floats]:
    """B(s) for each column s that matters, shape (n, n) each; arrays come as bytes, since each round asks again."""
    model, n = CavityModel(cell, free, np.frombuffer(held).copy(), *sides), len(free)
    at, known = np.frombuffer(mean).copy(), np.frombuffer(covariance).reshape(n, n)
    rows = seen_by_all(candidate_sweeps(cell, n=N_SWEEPS, rng=np.random.default_rng(0)), cell).laid_out(model)

    def seen(state: Floats) -> Floats:
        return model.predict_with_jacobian(free.nominal + free.prior_sd * state, rows)[1] * free.prior_sd / SIGMA

    # What no row tells keeps its direction: one row each, of its prior's size.
    to_state = np.linalg.pinv(np.vstack([np.eye(n), seen(at)]))[:, n:]
    variances, directions = np.linalg.eigh(known)
    aways = [np.sqrt(variances[i]) * directions[:, i] for i in np.flatnonzero(variances > _LEAST_SD**2)]
    return [to_state @ ((seen(at + away) - seen(at - away)) / 2.0) for away in aways]
