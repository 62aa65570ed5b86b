"""What a drift does beyond its stated size, because the geometry through which it acts is not exactly known.

After a calibration some combinations of the parameters are known to about a degree only: nothing measured then depends
on them. What a later drift does to the cavity length does depend on them, by a share of about that angle. The part of
the drift that sessions find is carried by the state itself, whose covariance is seen through the derivatives at the new
mean. The part that is not yet found acts through derivatives J(x) at an unknown x, and not through J(m):

    J(x) dx = J(m) T(x) dx,    T(x) = J(m)^+ J(x),

so that the covariance of T(x) dx over x ~ N(m, P) and dx ~ N(0, Q) is, to first order in x - m,

    Q + sum over columns s of the root of P of B(s) Q B(s)',    B(s) = T(m + s) - 1.

The sum is the mixed term of a second-order filter (Jazwinski 1970, section 9.3). Its other terms, of P with itself,
are no part of it: the start of the filter holds them (see `linear_start`), and later sessions are linearised where they
lead (see `following`).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.planning.candidates import candidate_sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.track.drift import DriftModel
from fpcal_bayes.track.filter import State
from fpcal_bayes.track.linear_start import N_SWEEPS, SIGMA

Floats = NDArray[np.float64]

#: Combinations known better than this, in prior standard deviations, turn the geometry by nothing that matters.
_LEAST_SD = 1e-3


def with_hidden_noise(drift: DriftModel, model: CavityModel, state: State) -> DriftModel:
    """The drift with the noise that an uncertain geometry adds to it.

    Parameters
    ----------
    drift, model
        Of the same parameters.
    state
        After the calibration.

    Returns
    -------
    DriftModel
        With `hidden`; as it was where the cell leaves no room for sweeps.
    """
    n = drift.n_parameters
    try:
        asked = candidate_sweeps(model.cell, n=N_SWEEPS, rng=np.random.default_rng(0))
    except InputError:
        return drift
    rows = model.rows(asked.q_start, asked.q_end, asked.absolute)

    def seen(mean: Floats) -> Floats:
        jacobian: Floats = model.predict_with_jacobian(drift.values(mean), rows)[1] * drift.scale / SIGMA
        return jacobian

    # What no row tells keeps its direction: one row each, of its prior's size.
    to_state = np.linalg.pinv(np.vstack([np.eye(n), seen(state.mean)]))[:, n:]
    variances, directions = np.linalg.eigh(state.covariance[:n, :n])
    hidden = np.zeros((n, n))
    for i in np.flatnonzero(variances > _LEAST_SD**2):
        away = np.zeros(drift.n_states)
        away[:n] = np.sqrt(variances[i]) * directions[:, i]
        turned = to_state @ ((seen(state.mean + away) - seen(state.mean - away)) / 2.0) * drift.walk
        hidden += turned @ turned.T
    return replace(drift, hidden=hidden)
