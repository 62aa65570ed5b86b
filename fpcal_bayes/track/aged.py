"""An estimate some time later: as good as drift has left it."""

from dataclasses import replace

from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.track.drift import DriftModel


def aged(estimate: Estimate, hours: float) -> Estimate:
    """An estimate `hours` later: its covariance has grown by the cell's drift.

    Raises
    ------
    InputError
        If the cell states no drift.
    """
    drift = DriftModel.of(estimate.cell, estimate.parameters)
    _, before = drift.initial(estimate.values, estimate.covariance)
    step = drift.transition(hours)
    return replace(estimate, covariance=drift.covariance(step.matrix @ before @ step.matrix.T + step.noise))
