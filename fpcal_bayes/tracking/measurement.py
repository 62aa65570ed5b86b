"""What a filter takes in: rows that depend on the state, whitened."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.noise import Whitening, whitening_of
from fpcal_bayes.infer.mechanics.rows import with_scale
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.tracking.drift import DriftModel

#: With more whitened rows than this for each state, fewer rows that say the same take their place.
_ROWS_PER_STATE = 2


def equivalent_rows(misfit: Floats, jacobian: Floats) -> tuple[Floats, Floats]:
    """Few whitened rows that say the same about the state as many: misfit (n_rows,), derivatives (n_rows, n_states)."""
    n_rows, n_states = jacobian.shape
    if n_rows <= _ROWS_PER_STATE * n_states:
        return misfit, jacobian
    # Square-root information filter (Bierman 1977), rows of zeros dropped.
    triangle = np.linalg.qr(np.column_stack([jacobian, misfit]), mode="r")
    return triangle[:, n_states], triangle[:, :n_states]


@dataclass(frozen=True)
class LinearMeasurement:
    """Rows ``z = H x + e`` with e of unit covariance."""

    z: Floats  # whitened, shape (n_rows,)
    h: Floats  # likewise, shape (n_rows, n_states)
    log_volume: float = 0.0  # logarithm of the determinant of the whitening

    def misfit(self, mean: Floats) -> Floats:
        """Whitened measurement minus prediction at a state (n_states,), shape (n_rows,)."""
        return self.z - self.h @ mean

    def linearise(self, mean: Floats) -> tuple[Floats, Floats]:
        """The misfit, and the derivatives of the whitened prediction by the state, shape (n_rows, n_states)."""
        return self.misfit(mean), self.h


@dataclass(frozen=True, repr=False)
class SweepMeasurement(Brief):
    """The changes of cavity length of a session's sweeps."""

    drift: DriftModel  # what the state means
    model: CavityModel  # cavity model of the same parameters
    rows: Rows  # sweeps laid out for the kernels
    target: Floats  # their measured changes with sign, shape (n_rows,)
    whitening: Whitening
    motions: Floats | None = None  # derivatives by the states of the error motions, shape (n_rows, n_motions), in um

    @classmethod
    def of(cls, drift: DriftModel, model: CavityModel, sweeps: Sweeps, mean: Floats) -> "SweepMeasurement":
        """The measurement of `sweeps`; what joints add is carried through the model at the state `mean`."""
        rows, values = sweeps.laid_out(model), drift.values(mean)
        if drift.motions is None:
            return cls(drift, model, rows, sweeps.dl, with_scale(whitening_of(model, sweeps, values), sweeps))
        return cls(drift, model, rows, sweeps.dl, *drift.motions.rows(model, sweeps, values))

    @property
    def log_volume(self) -> float:
        """Logarithm of the factor by which the whitening stretches the space of the rows."""
        return self.whitening.log_volume

    def predict(self, mean: Floats) -> Floats:
        """Changes that the state predicts, not whitened, shape (n_rows,), in um."""
        return self.model.predict(self.drift.values(mean), self.rows) + self._moved(mean)

    def misfit(self, mean: Floats) -> Floats:
        """As of `LinearMeasurement`."""
        return self.whitening.apply(self.target - self.predict(mean))

    def linearise(self, mean: Floats) -> tuple[Floats, Floats]:
        """As of `LinearMeasurement`."""
        predicted, jacobian = self.model.predict_with_jacobian(self.drift.values(mean), self.rows)
        n = self.drift.n_parameters
        full = np.zeros((len(predicted), self.drift.n_states))
        full[:, :n] = self.whitening.apply(jacobian * self.drift.scale)
        if self.motions is not None:
            full[:, n : self.drift.n_lengths] = self.whitening.apply(self.motions)
        return self.whitening.apply(self.target - predicted - self._moved(mean)), full

    def _moved(self, mean: Floats) -> Floats | float:
        """What the error motions add, shape (n_rows,), in um."""
        return 0.0 if self.motions is None else self.motions @ mean[self.drift.n_parameters : self.drift.n_lengths]


#: Rows with independent errors of unit variance.
Measurement = LinearMeasurement | SweepMeasurement
