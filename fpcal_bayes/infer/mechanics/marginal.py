"""Whitening of rows whose mechanics are marginalised: covariance Sigma + B S B', of low rank beside Sigma."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.noise import Whitening

#: Directions whose variance is below this share of the noise's change nothing.
_NEGLIGIBLE = 1e-6


@dataclass(frozen=True)
class MarginalWhitening(Whitening):
    """Linear map under which rows with covariance Sigma + B S B' have unit covariance.

    With Sigma whitened, the covariance is I + U s^2 U'; the map is its symmetric inverse root, which shrinks the few
    directions U: never a matrix of rows by rows.

    Attributes
    ----------
    directions
        U, shape (n_rows, rank).
    shrink
        1 - 1 / sqrt(1 + s^2), shape (rank,).
    """

    directions: Floats = None  # type: ignore[assignment]
    shrink: Floats = None  # type: ignore[assignment]

    @classmethod
    def around(cls, base: Whitening, weights: Floats) -> "MarginalWhitening":
        """From the whitening of Sigma and the weights' columns B sqrt(S), shape (n_rows, n_weights)."""
        columns = base.apply(weights)
        n, m = columns.shape
        if m == 0:
            return cls(base.scale, base.batches, np.zeros((n, 0)), np.zeros(0))
        if m < n:
            variance, vectors = linalg.eigh(columns.T @ columns)
            kept = variance > max(_NEGLIGIBLE, 1e-14 * variance[-1])
            directions = columns @ (vectors[:, kept] / np.sqrt(variance[kept]))
        else:
            variance, directions = linalg.eigh(columns @ columns.T)
            kept = variance > _NEGLIGIBLE
            directions = directions[:, kept]
        return cls(
            base.scale, base.batches, np.ascontiguousarray(directions), 1.0 - 1.0 / np.sqrt(1.0 + variance[kept])
        )

    def apply(self, rows: Floats) -> Floats:
        """Whiten a vector (n_rows,), the columns of a matrix (n_rows, n), or of many (n_points, n_rows, n)."""
        result = super().apply(rows)
        if rows.ndim == 1:
            return result - self.directions @ (self.shrink * (self.directions.T @ result))
        whitened: Floats = result - self.directions @ (self.shrink[:, None] * (self.directions.T @ result))
        return whitened

    def weigh(self, rows: Floats) -> Floats:
        """Multiply a vector (n_rows,) by the inverse covariance."""
        # The whitened map is W = T M, M whitening Sigma and T symmetric: W'W = M' T^2 M.
        scaled = super().apply(rows)
        double = 1.0 - (1.0 - self.shrink) ** 2
        scaled = scaled - self.directions @ (double * (self.directions.T @ scaled))
        mix = self.base_mix
        result: Floats = scaled * self.scale if mix is None else mix.T @ scaled
        return result

    @property
    def base_mix(self) -> sparse.csr_array | None:
        """The map that whitens Sigma, as a sparse matrix, or None if it only scales."""
        return Whitening(self.scale, self.batches).mix
