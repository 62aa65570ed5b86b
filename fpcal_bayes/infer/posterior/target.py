"""The density that is sampled: half a sum of squares of data rows, and unit normal prior rows."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.infer.problem import Problem

Floats = NDArray[np.float64]


class Target(Protocol):
    """A density exp(-(|r(v)|^2 + |v|^2) / 2) over n unknowns, r being the whitened data residuals.

    `log_density` may add a factor that the residuals do not hold; charts then only propose, and the factor is met by
    the Metropolis step.
    """

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns."""

    def data_batch(self, points: Floats) -> tuple[Floats, Floats]:
        """Residuals (n_points, n_rows) and derivatives (n_points, n_rows, n) at points (n_points, n)."""

    def data_residuals(self, points: Floats) -> Floats:
        """The residuals alone, which cost much less."""

    def log_density(self, residuals: Floats, points: Floats) -> Floats:
        """Unnormalised log density (n_points,) from residuals (n_points, n_rows) and points (n_points, n)."""


def half_squares(residuals: Floats, points: Floats) -> Floats:
    """Minus half the sum of squares of data and prior rows, shape (n_points,)."""
    total: Floats = -0.5 * ((residuals**2).sum(axis=1) + (points**2).sum(axis=1))
    return total


class PosteriorTarget:
    """The posterior of a least-squares problem, with a count of the points at which it was evaluated.

    A row of unknown sign is the size of a change: its density is the sum of those of both signs. Rows that share a
    reading are taken with the sign that was decided.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.evaluations = 0
        # Large problems are evaluated a few points at a time, so that memory stays small.
        self._block = max(1, 20_000_000 // (len(problem.target) * problem.n_unknowns))
        sweeps = problem.sweeps
        folded = ~(sweeps.signed | sweeps.absolute)
        self._folded = np.flatnonzero(folded) if problem.whitening.mix is None else np.zeros(0, dtype=np.int64)
        self._twice = 2.0 * (problem.target * problem.whitening.scale)[self._folded]

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns."""
        return self.problem.n_unknowns

    def data_batch(self, points: Floats) -> tuple[Floats, Floats]:
        """Whitened data residuals and derivatives at `points`."""
        self.evaluations += len(points)
        if len(points) <= self._block:
            return self.problem.data_batch(points)
        parts = [self.problem.data_batch(points[i : i + self._block]) for i in range(0, len(points), self._block)]
        return np.concatenate([r for r, _ in parts]), np.concatenate([j for _, j in parts])

    def data_residuals(self, points: Floats) -> Floats:
        """Whitened data residuals at `points`."""
        self.evaluations += len(points)
        problem = self.problem
        change = problem.model.predict(problem.values(points), problem.rows) - problem.target
        if problem.sensitivity is not None:
            change = change + points[:, problem.n_free :] @ problem.sensitivity.T
        return problem.whitening.apply(change.T).T

    def log_density(self, residuals: Floats, points: Floats) -> Floats:
        """Unnormalised log posterior."""
        total = half_squares(residuals, points)
        if len(self._folded):
            total += self._other_sign(residuals).sum(axis=1)
        return total

    def log_likelihoods(self, points: Floats) -> Floats:
        """Log likelihood of each row at points (n_points, n_unknowns), shape (n_points, n_rows); per um.

        Of rows that share a reading, that of a row given those before it in its group.
        """
        residuals, _ = self.data_batch(points)
        result = -0.5 * residuals**2
        result[:, self._folded] += self._other_sign(residuals)
        return result + self.log_scale

    @property
    def log_scale(self) -> Floats:
        """Log density of each row at zero residual, shape (n_rows,)."""
        whitening = self.problem.whitening
        scale = whitening.scale if whitening.mix is None else whitening.mix.diagonal()
        result: Floats = np.log(scale) - 0.5 * np.log(2.0 * np.pi)
        return result

    def _other_sign(self, residuals: Floats) -> Floats:
        """What the other sign adds to the log density of rows whose sign is not known."""
        # Residual r with the sign that was decided, r + 2 t with the other one.
        other = self._twice * (residuals[:, self._folded] + 0.5 * self._twice)
        return np.logaddexp(0.0, -other)
