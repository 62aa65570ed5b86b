"""Whitening of rows whose mechanics are marginalised: covariance Sigma + B S B', of low rank beside Sigma."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.noise import Whitening

#: With more rows than this no matrix of rows by rows is made.
_MOST_DENSE = 1000
#: Directions whose variance is below this share of the noise's change nothing.
_NEGLIGIBLE = 1e-6


@dataclass(frozen=True, repr=False)
class MarginalWhitening(Whitening):
    """Linear map under which rows with covariance Sigma + B S B' have unit covariance.

    With Sigma whitened, the covariance is I + U s^2 U'; the map is its symmetric inverse root, which shrinks the few
    directions U: never a matrix of rows by rows.
    """

    # U, shape (n_rows, rank)
    directions: Floats = None  # type: ignore[assignment]
    # 1 - 1 / sqrt(1 + s^2), shape (rank,)
    shrink: Floats = None  # type: ignore[assignment]
    # variance of each row by the weights, in um^2, shape (n_rows,)
    added: Floats = None  # type: ignore[assignment]

    @classmethod
    def around(cls, base: Whitening, weights: Floats) -> "MarginalWhitening":
        """From the whitening of Sigma and the weights' columns B sqrt(S), shape (n_rows, n_weights)."""
        columns = base.apply(weights)
        n, m = columns.shape
        if m == 0:
            return cls(base.scale, base.batches, np.zeros((n, 0)), np.zeros(0), np.zeros(n))
        if m < n:
            variance, vectors = linalg.eigh(columns.T @ columns)
            kept = variance > max(_NEGLIGIBLE, 1e-14 * variance[-1])
            directions = columns @ (vectors[:, kept] / np.sqrt(variance[kept]))
        else:
            variance, directions = linalg.eigh(columns @ columns.T)
            kept = variance > _NEGLIGIBLE
            directions = directions[:, kept]
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + variance[kept])
        return cls(base.scale, base.batches, np.ascontiguousarray(directions), shrink, (weights**2).sum(axis=1))

    def apply(self, rows: Floats) -> Floats:
        """Whiten a vector (n_rows,), the columns of a matrix (n_rows, n), or of many (n_points, n_rows, n)."""
        result = super().apply(rows)
        if rows.ndim == 1:
            return result - self.directions @ (self.shrink * (self.directions.T @ result))
        return np.asarray(result - self.directions @ (self.shrink[:, None] * (self.directions.T @ result)))

    def unwhiten(self, rows: Floats) -> Floats:
        """Undo `apply` on the columns of a matrix (n_rows, n)."""
        wide = rows + self.directions @ ((1.0 / (1.0 - self.shrink) - 1.0)[:, None] * (self.directions.T @ rows))
        return Whitening(self.scale, self.batches).unwhiten(wide)

    def weigh(self, rows: Floats) -> Floats:
        """Multiply a vector (n_rows,) by the inverse covariance."""
        return np.asarray(self.weigh_each(rows[None])[0])

    def weigh_each(self, rows: Floats) -> Floats:
        """Multiply each of many vectors (n_vectors, n_rows) by the inverse covariance."""
        # The whitened map is W = T M, M whitening Sigma and T symmetric: W'W = M' T^2 M.
        scaled = super().apply(np.ascontiguousarray(rows.T))
        double = 1.0 - (1.0 - self.shrink) ** 2
        scaled = scaled - self.directions @ (double[:, None] * (self.directions.T @ scaled))
        mix = self.base_mix
        return np.asarray(scaled.T * self.scale if mix is None else (mix.T @ scaled).T)

    @property
    def only_scales(self) -> bool:
        """Never: the weights mix the rows."""
        return False

    @property
    def log_volume(self) -> float:
        """See `Whitening`."""
        return super().log_volume + float(np.log1p(-self.shrink).sum())

    @property
    def variance(self) -> Floats:
        """Variance of each row in um^2, shape (n_rows,)."""
        return super().variance + self.added

    def scaled(self, factor: float) -> "MarginalWhitening":
        """The whitening of rows whose errors are `factor` times as large."""
        wider = super().scaled(factor)
        return replace(self, scale=wider.scale, batches=wider.batches, added=self.added * factor**2)

    @cached_property
    def mix(self) -> sparse.csr_array | None:
        """The map as a matrix (n_rows, n_rows); of many rows that of Sigma alone, or None if it only scales."""
        n = len(self.scale)
        return self.base_mix if n > _MOST_DENSE else sparse.csr_array(self.apply(np.eye(n)))

    @cached_property
    def base_mix(self) -> sparse.csr_array | None:
        """The map that whitens Sigma, as a sparse matrix, or None if it only scales."""
        return Whitening(self.scale, self.batches).mix
