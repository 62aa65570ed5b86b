"""An identification of the extrinsic parameters made while the intrinsic ones were held at stale values.

Such an estimate is biased by what the intrinsic parameters have moved since, and its bias is correlated with the
state. What it says about the sweeps behind it is exact all the same: at its minimum, the weighted sum of the sweeps
along the columns of the Jacobian is known (a sufficient statistic of the linearised fit). That sum is a measurement of
all parameters, extrinsic and intrinsic (Schmidt 1966 calls the latter considered).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.covariance import Whitening, whitening_of
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.track.drift import DriftModel

Floats = NDArray[np.float64]

#: Combinations of the sweeps with less than this share of the largest information are rounding.
_INFORMATIVE = 1e-12


@dataclass(frozen=True)
class StaleMeasurement:
    """What an identification with held parameters says about all parameters; a `Measurement`.

    Attributes
    ----------
    drift, model
        What the state means, and the cavity model of the same parameters.
    rows, whitening
        The sweeps behind the identification.
    weights
        Combinations of whitened sweeps that the fit determined, orthonormal, shape (n_combinations, n_rows).
    target
        Their values, shape (n_combinations,).
    """

    drift: DriftModel
    model: CavityModel
    rows: Rows
    whitening: Whitening
    weights: Floats
    target: Floats
    log_volume: float = 0.0

    def misfit(self, mean: Floats) -> Floats:
        """Measurement minus prediction at a state (n_states,), shape (n_combinations,)."""
        predicted = self.whitening.apply(self.model.predict(self.drift.values(mean), self.rows))
        result: Floats = self.target - self.weights @ predicted
        return result

    def linearise(self, mean: Floats) -> tuple[Floats, Floats]:
        """The misfit, and the derivatives of the prediction by the state, shape (n_combinations, n_states)."""
        predicted, jacobian = self.model.predict_with_jacobian(self.drift.values(mean), self.rows)
        full = np.zeros((len(self.target), self.drift.n_states))
        full[:, : self.drift.n_parameters] = self.weights @ self.whitening.apply(jacobian * self.drift.scale)
        return self.target - self.weights @ self.whitening.apply(predicted), full


def stale_measurement(drift: DriftModel, plan: Sweeps, estimate: Estimate, free: tuple[str, ...]) -> StaleMeasurement:
    """The measurement that an identification of some parameters amounts to.

    Parameters
    ----------
    drift
        Of the state that will take it in.
    plan
        The sweeps that were fitted; their `sigma` counts, their `dl` need not be known.
    estimate
        The result: fitted values of `free`, and the values at which all others were held as exact.
    free
        Names of the parameters that were fitted, under the cell's prior.

    Raises
    ------
    InputError
        If a name is unknown to the estimate, or the sweeps carry no sigma.
    """
    if not np.isfinite(plan.sigma).all():
        raise InputError(f"{plan.file}: expected sigma_um in every row of the sweeps behind the identification")
    cell = estimate.cell
    fitted = cell.select(free)
    values, _ = estimate.block(fitted.names)
    vector = estimate.vector()
    model = CavityModel.of(cell, fitted, vector)
    rows = model.rows(plan.q_start, plan.q_end, plan.absolute)
    whitening = whitening_of(model, plan, values)
    predicted, jacobian = model.predict_with_jacobian(values, rows)
    scaled = whitening.apply(jacobian * fitted.prior_sd)
    # At the minimum J'(y - h) equals the prior's pull, so J'y is known.
    pull = (values - fitted.nominal) / fitted.prior_sd
    left, singular, right = np.linalg.svd(scaled, full_matrices=False)
    seen = singular > np.sqrt(_INFORMATIVE) * singular.max(initial=0.0)
    weights = left.T[seen]
    target = weights @ whitening.apply(predicted) + (right @ pull)[seen] / singular[seen]
    return StaleMeasurement(drift, CavityModel.of(cell, drift.parameters, vector), rows, whitening, weights, target)
