"""The error motions of a machine as states that stay from session to session.

The weights of a cell's error motions are some two hundred; a cavity length feels a few tens of their combinations. Those
are the states: w = basis z + rest, z of unit prior variance at the sizes that the calibration found. What a combination
beyond them adds to a row, and what is new in each session (its drift, a first approach, slow readings), counts as noise.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.mechanics.known import random_poses
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.infer.mechanics.rows import RowNoise
from fpcal_bayes.measure.drive import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.mechanics import Terms, design, path_design

#: Combinations whose effect on the cavity length is below this, in um, root mean square over poses, are noise.
_NEGLIGIBLE = 1.5e-3
_MOST_STATES = 36


@dataclass(frozen=True)
class MotionStates:
    """What the states of the error motions stand for.

    Attributes
    ----------
    terms
        The weights of the cell.
    log_scales
        Logarithms of the factors on the stated sizes, as the calibration found them: draws, shape (n_draws, n_scales).
    session_min
        How long the calibration took, in minutes.
    """

    terms: Terms
    log_scales: Floats
    session_min: float

    @classmethod
    def of(cls, fit: MechanicsFit) -> "MotionStates":
        """As a calibration found them."""
        return cls(fit.terms, fit.scales.log, float(fit.drive.end_min.max()))

    @cached_property
    def factors(self) -> Floats:
        """Typical factors on the stated sizes, shape (n_scales,)."""
        return np.exp(self.log_scales.mean(axis=0))

    @cached_property
    def sizes(self) -> Floats:
        """Standard deviations of the weights in units of their stated sizes, shape (n_weights,)."""
        cell, n = self.terms.cell, len(self.terms.cell.joints)
        # Which scale a weight has does not depend on rows.
        row = Sweeps.of_um_rad(np.zeros((1, n)), np.where(np.arange(n) == 0, 1.0, 0.0)[None])
        made = design(self.terms, cell.parameters.nominal, drive_of_sweeps(row, 1.0), np.ones(1))
        return np.asarray(self.factors[made.scale[: made.motion_count]])

    @cached_property
    def directions(self) -> Floats:
        """Orthonormal combinations of weights of unit variance, the most felt ones first, shape (n_weights, n_states)."""
        middle, poses = random_poses(self.terms.cell, np.random.default_rng(4))
        felt = path_design(self.terms, self.terms.cell.parameters.nominal, middle, poses).motions * self.sizes
        _, effect, vectors = np.linalg.svd(felt, full_matrices=False)
        count = int((effect > _NEGLIGIBLE * np.sqrt(len(poses))).sum())
        return np.ascontiguousarray(vectors[: min(count, _MOST_STATES)].T)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return self.directions.shape[1]

    @property
    def basis(self) -> Floats:
        """Weights, in units of their stated sizes, by states, shape (n_weights, n_states)."""
        return self.sizes[:, None] * self.directions

    def rows(self, model: CavityModel, sweeps: Sweeps, values: Floats) -> tuple[MarginalWhitening, Floats]:
        """Whitening of the rows of a session, and their derivatives by the states, shape (n_rows, n_states), in um.

        Both at free parameters `values` (n,).
        """
        drive = drive_of_sweeps(sweeps, self.terms.sizes.minutes_per_sweep)
        made = design(self.terms, model.vector(values), drive, sweeps.sigma)
        n = made.motion_count
        shared = made.matrix[:, :n] * self.sizes
        felt = shared @ self.directions
        own = made.matrix[:, n:] * self.factors[made.scale[n:]]
        noise = RowNoise.of(sweeps, made).whitening(float(self.factors[-1]), float(self.factors[-2]))
        return MarginalWhitening.around(noise, np.hstack([own, shared - felt @ self.directions.T])), felt

    def start(self, fit: MechanicsFit) -> tuple[Floats, Floats]:
        """Mean and covariance of geometry and states after the calibration, in units of the prior, over all scales."""
        along = np.zeros((len(fit.rows.scale), self.n_states))
        along[: len(self.sizes)] = self.directions / self.sizes[:, None]
        return fit.moments(along)


def cell_terms(cell: Cell) -> Terms:
    """The weights of a cell whose free parameters are all followed."""
    assert cell.mechanics is not None
    return Terms.of(cell, cell.mechanics, cell.free.names)
