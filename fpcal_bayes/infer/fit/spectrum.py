"""What a set of sweeps can tell about the parameters: rank, unobservable directions, status of each parameter."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import linalg

from fpcal_bayes.core.typing import Floats

Status = Literal["identified", "weak", "gauge", "fixed"]

#: A singular value below this share of the largest one counts as zero. The weakest direction that the paper's sweeps
#: see stands at 7e-5, rounding errors at 1e-14.
RELATIVE_TOLERANCE = 1e-9
#: A parameter whose share in the null space exceeds this is a gauge.
GAUGE_SHARE = 0.1
#: A parameter is weak if the data leave more than this share of its prior variance.
WEAK_SHARE = 0.5


@dataclass(frozen=True)
class Spectrum:
    """Singular values and vectors of a whitened, prior-scaled Jacobian."""

    # descending, shape (n,): what each direction tells, in prior over noise standard deviations
    singular_values: Floats
    directions: Floats  # right singular vectors as rows, shape (n, n), in prior-scaled units
    tolerance: float  # singular values at or below it count as zero
    rank: int  # number of singular values above it
    gap: float  # ratio of the last singular value that counts to the first that does not; infinite at full rank

    @property
    def observable(self) -> Floats:
        """Directions that the data see, shape (rank, n)."""
        return self.directions[: self.rank]

    @property
    def null_space(self) -> Floats:
        """Directions that the data do not see at all, shape (n - rank, n)."""
        return self.directions[self.rank :]

    @property
    def null_share(self) -> Floats:
        """Share of each parameter in the null space, from 0 to 1, shape (n,)."""
        return (self.null_space**2).sum(axis=0)


def spectrum_of(jacobian: Floats) -> Spectrum:
    """Singular value analysis of a whitened Jacobian (n_rows, n) in prior-scaled units."""
    n = jacobian.shape[1]
    # The triangle has the same singular values and is small, however many rows there are.
    triangle = linalg.qr(jacobian, mode="r")[0][:n]
    _, found, directions = linalg.svd(triangle, full_matrices=True)
    values = np.zeros(n)
    values[: len(found)] = found
    tolerance = RELATIVE_TOLERANCE * float(values[0]) if n else 0.0
    rank = int(np.count_nonzero(values > tolerance))
    beyond = float(values[rank]) if rank < n else 0.0
    gap = float(values[rank - 1]) / beyond if rank and beyond > 0 else float("inf")
    return Spectrum(values, directions, tolerance, rank, gap)


def statuses(null_share: Floats, posterior_share: Floats, weak_share: float = WEAK_SHARE) -> tuple[Status, ...]:
    """Status of each parameter from its share in the null space and its posterior over prior variance, shapes (n,).

    Above `weak_share` of its prior variance a parameter is weak.
    """
    return tuple(
        "gauge" if null > GAUGE_SHARE else "weak" if left > weak_share else "identified"
        for null, left in zip(null_share, posterior_share, strict=True)
    )
