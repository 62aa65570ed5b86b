"""What a set of sweeps tells of the parameters (rank, unobservable directions, status), and how well it is met."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.problem import Problem

Status = Literal["identified", "weak", "gauge", "fixed"]

#: A singular value below this share of the largest one counts as zero. The weakest direction that the paper's sweeps
#: see stands at 7e-5, rounding errors at 1e-14.
RELATIVE_TOLERANCE = 1e-9
#: A parameter whose share in the null space exceeds this is a gauge.
GAUGE_SHARE = 0.1
#: A parameter is weak if the data leave more than this share of its prior variance.
WEAK_SHARE = 0.5


@dataclass(frozen=True, repr=False)
class Spectrum(Brief):
    """Singular values and vectors of a whitened, prior-scaled Jacobian."""

    singular_values: Floats  # descending, shape (n,): prior over noise standard deviations of each direction
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
    _, found, directions = linalg.svd(linalg.qr(jacobian, mode="raw")[1][:n], full_matrices=True)
    values = np.zeros(n)
    values[: len(found)] = found
    tolerance = RELATIVE_TOLERANCE * float(values[0]) if n else 0.0
    rank = int(np.count_nonzero(values > tolerance))
    beyond = float(values[rank]) if rank < n else 0.0
    gap = float(values[rank - 1]) / beyond if rank and beyond > 0 else float("inf")
    return Spectrum(values, directions, tolerance, rank, gap)


def statuses(null_share: Floats, posterior_share: Floats) -> tuple[Status, ...]:
    """Status of each parameter from its share in the null space and its posterior over prior variance, shapes (n,)."""
    return tuple(
        "gauge" if null > GAUGE_SHARE else "weak" if left > WEAK_SHARE else "identified"
        for null, left in zip(null_share, posterior_share, strict=True)
    )


@dataclass(frozen=True)
class GoodnessOfFit:
    """How well the data are met at the maximum of the posterior."""

    chi2_data: float  # sum of squares of the whitened data rows
    expected: float  # its expected value: the number of rows less those that the parameters absorb
    p_value: float  # probability of a larger value if model, prior and noise are right
    standardised: Floats  # residual of each whitened row over its own standard deviation, shape (n_rows,)

    def largest(self, labels: Sequence[str], n: int) -> list[tuple[str, float]]:
        """Labels of the rows (n_rows,) with the `n` largest standardised residuals, largest first."""
        order = np.argsort(-np.abs(self.standardised), kind="stable")[:n]
        return [(labels[i], float(self.standardised[i])) for i in order]


def goodness_of_fit(problem: Problem, unknowns: Floats) -> GoodnessOfFit:
    """How well the data of a problem are met at `unknowns` (n_unknowns,)."""
    residuals = problem.data_residuals(unknowns)
    chi2_data = float(residuals @ residuals)
    jacobian = problem.jacobian(unknowns)
    orthonormal = linalg.qr(jacobian, mode="economic")[0][: len(residuals)]
    leverage = np.square(orthonormal, out=orthonormal).sum(axis=1)
    del orthonormal
    standardised = residuals / np.sqrt(np.clip(1.0 - leverage, 1e-12, None))
    # Under the model the residuals are N(0, I - H), so their sum of squares is a sum of chi-squares with weights 1 - h,
    # h the eigenvalues of H; a scaled chi-square with the same mean and variance stands for it (Satterthwaite 1946).
    shrink = linalg.svdvals(jacobian[: len(residuals)])[: problem.n_unknowns]
    weights = np.ones(max(len(residuals), len(shrink)))
    weights[: len(shrink)] = 1.0 / (1.0 + shrink**2)
    mean, square = float(weights.sum()), float((weights**2).sum())
    return GoodnessOfFit(chi2_data, mean, chi2_tail(chi2_data * mean / square, mean**2 / square), standardised)
