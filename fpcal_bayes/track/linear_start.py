"""Where a linear filter starts from a curved posterior.

After a calibration the parameters are known well across, and badly along, surfaces that are curved. The maximum of the
posterior with its Laplace covariance knows nothing of the bend: of tilts it promises too much. The covariance of
posterior draws as they are takes the bend for width across. So each draw is first moved to the point from which the
model, linearised at the maximum, predicts as nearly as any what the model predicts of the draw; the second moments of
those points about the maximum are what a linear filter can take over (statistical linearisation in the space of what
can be measured). The maximum stays: away from it the derivatives, turned against the covariance, would spread again.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.infer.planning.candidates import candidate_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate

Floats = NDArray[np.float64]

#: Random sweeps that stand for what will be asked of the model, and the weight of each, as its sigma in um.
N_SWEEPS, SIGMA = 200, 0.005
#: Added variance of each direction, as a share of the prior's: rounding.
_JITTER = 1e-18


def linear_start(estimate: Estimate, draws: Floats, sweeps: Sweeps) -> Estimate:
    """The maximum of the posterior, with the covariance by which its linearised predictions spread as the draws do.

    Parameters
    ----------
    estimate
        Maximum of the posterior.
    draws
        Of the same parameters, in um and rad, shape (n_draws, n), more than n of them.
    sweeps
        Of the calibration.

    Raises
    ------
    InputError
        If the cell leaves no room for sweeps.
    """
    parameters = estimate.parameters
    model = CavityModel.of(estimate.cell, parameters, estimate.vector())
    sd = parameters.prior_sd
    random = candidate_sweeps(estimate.cell, n=N_SWEEPS, rng=np.random.default_rng(0))
    # Where no row tells a direction, the parameters themselves do: one row each, of their prior's size.
    jacobians, changes = [np.eye(len(sd))], [(draws - estimate.values) / sd]
    for asked in (random, sweeps.take(sweeps.kind != "path")):
        rows = model.rows(asked.q_start, asked.q_end, asked.absolute)
        predicted, jacobian = model.predict_with_jacobian(estimate.values, rows)
        jacobians.append(jacobian * sd / SIGMA)
        changes.append((model.predict(draws, rows) - predicted) / SIGMA)
    moved = np.linalg.lstsq(np.vstack(jacobians), np.hstack(changes).T, rcond=None)[0].T
    covariance = moved.T @ moved / len(moved) + _JITTER * np.eye(len(sd))
    return replace(estimate, covariance=covariance * np.outer(sd, sd))
