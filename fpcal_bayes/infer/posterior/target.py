"""The density that is sampled: half a sum of squares of data rows, and unit normal prior rows."""

import copy
from typing import Self

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.fit.student import StudentTangent, bend, log_peak

#: A row of unknown sign this near to zero, in standard deviations, is proposed for both signs at once.
_NEAR_ZERO = 3.0
_LOG_PEAK = -0.5 * float(np.log(2.0 * np.pi))
#: Numbers of residuals or derivatives that are worked out together.
_NUMBERS = 4_000_000


class PosteriorTarget:
    """exp(-(|r(v)|^2 + |v|^2) / 2) of n unknowns v, r being the whitened data residuals, with a count of evaluations.

    `log_density` may add a factor that the residuals do not hold: charts only propose, the Metropolis step meets it.
    A row of unknown sign is the size of a change: its density is the sum of those of both signs. Rows that share a
    reading are taken with the sign that was decided.

    dof: degrees of freedom of Student-t rows; None for Gaussian ones.
    doubt: probability that each row's sign is the other, (n_rows,): near zero such rows are proposed for both at once.
    """

    def __init__(self, problem: Problem, *, dof: float | None = None, doubt: Floats | None = None) -> None:
        self.problem, self.dof = problem, dof
        self._count = [0]
        self._tangent: StudentTangent | None = None
        sweeps = problem.sweeps
        folded = ~(sweeps.signed | sweeps.absolute)
        self._folded = np.flatnonzero(folded) if problem.whitening.mix is None else np.zeros(0, dtype=np.int64)
        self._twice = 2.0 * (problem.target * problem.whitening.scale)[self._folded]
        near = np.zeros(len(self._folded), dtype=bool)
        if doubt is not None:
            near = (np.abs(self._twice) < 2.0 * _NEAR_ZERO) & (doubt[self._folded] > 1e-4)
        self._near = self._folded[near]
        self._offset = 0.5 * self._twice[near]
        # Both signs together have this variance about zero.
        self._shrink = 1.0 / np.sqrt(1.0 + self._offset**2)

    @property
    def evaluations(self) -> int:
        """Points at which the density was evaluated."""
        return self._count[0]

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns."""
        return self.problem.n_unknowns

    @property
    def at_once(self) -> int:
        """At how many points derivatives are worked out together, so that they take little memory."""
        return max(1, _NUMBERS // (len(self.problem.target) * self.problem.n_unknowns))

    def centred(self, reference: Floats) -> Self:
        """The same density near `reference` (n_unknowns,): signs as predicted there, Student-t rows by tangents."""
        result = self._signed_at(reference)
        if self.dof is not None:
            result = copy.copy(result)
            result._tangent = None
            rows = result.data_residuals(reference[None])[0, : len(self.problem.target)]
            result._tangent = StudentTangent.at(rows, self.dof)
        return result

    def _signed_at(self, reference: Floats) -> Self:
        if not len(self._folded):
            return self
        problem = self.problem
        whitened = problem.data_residuals(reference[: problem.n_unknowns])
        predicted = (whitened / problem.whitening.scale + problem.target)[self._folded]
        target = problem.target.copy()
        target[self._folded] = np.copysign(target[self._folded], predicted)
        other = copy.copy(self)
        other.problem = problem.with_target(target)
        signs = np.copysign(1.0, target * problem.target)
        other._twice = self._twice * signs[self._folded]
        other._offset = self._offset * signs[self._near]
        return other

    def data_batch(self, points: Floats) -> tuple[Floats, Floats]:
        """Residuals (n_points, n_rows) and derivatives (n_points, n_rows, n), as the charts take them."""
        self._count[0] += len(points)
        residuals, jacobian = self.problem.data_batch(points)
        if len(self._near):
            jacobian[:, self._near] *= self._shrink[:, None]
        residuals = self._widened(residuals)
        if self._tangent is not None:
            residuals = self._tangent.rows(residuals)
            jacobian *= self._tangent.gain[:, None]
        return residuals, jacobian

    def data_residuals(self, points: Floats) -> Floats:
        """The residuals alone, which cost much less."""
        residuals = self._widened(self.standardised(points))
        return residuals if self._tangent is None else self._tangent.rows(residuals)

    def standardised(self, points: Floats) -> Floats:
        """Whitened residuals at points (n_points, n_unknowns), shape (n_points, n_rows)."""
        self._count[0] += len(points)
        return self.problem.data_residuals(points[:, : self.problem.n_unknowns])

    def log_density(self, residuals: Floats, points: Floats) -> Floats:
        """Unnormalised log density (n_points,) from residuals (n_points, n_rows) and points (n_points, n)."""
        rows = residuals[:, : len(self.problem.target)]
        total: Floats = -0.5 * ((rows**2).sum(axis=1) + (points**2).sum(axis=1))
        if len(self._folded) or self.dof is not None:
            standardised = self._standardised(rows)
            if len(self._near) or self.dof is not None:
                total += 0.5 * ((rows**2).sum(axis=1) - (self._bent(standardised) ** 2).sum(axis=1))
            if len(self._folded):
                total += self._other_sign(standardised).sum(axis=1)
        return total

    def log_likelihoods(self, points: Floats) -> Floats:
        """Log likelihood of each row given those before it in its group, shape (n_points, n_rows); per um."""
        return self._row_log_likelihoods(self.standardised(points), points)

    def row_given_others(self, points: Floats) -> Floats:
        """Log density of each row given all others, per um, (n_points, n_rows) (Buerkner, Gabry, Vehtari 2021)."""
        mix = self.problem.whitening.mix
        if mix is None:
            return self.log_likelihoods(points)
        precision = np.asarray(mix.multiply(mix).sum(axis=0)).ravel()
        # Inverse covariance times the residual in um, row by row.
        weighed = self.standardised(points) @ mix
        return np.asarray(0.5 * np.log(precision / (2.0 * np.pi)) - 0.5 * weighed**2 / precision)

    def predictive_p(self, points: Floats, rng: np.random.Generator) -> float:
        """Share of repeats, one at each draw, that are less likely than the rows (posterior predictive check)."""
        both = (self.standardised(points), self.draw_noise(points, rng) + self._repeated())
        seen, again = (self._row_log_likelihoods(rows, points).sum(axis=1) for rows in both)
        return float(((again <= seen).sum() + 1) / (len(points) + 1))

    def _repeated(self) -> Floats:
        """What repeated rows have beside their errors, whitened, shape (n_rows,)."""
        return np.zeros(len(self.problem.target))

    def _row_log_likelihoods(self, standardised: Floats, points: Floats) -> Floats:
        result = -0.5 * self._bent(standardised) ** 2
        result[:, self._folded] += self._other_sign(standardised)
        return result + self.log_scale

    def draw_noise(self, points: Floats, rng: np.random.Generator) -> Floats:
        """Errors of the whitened rows at points (n_points, n_unknowns), shape (n_points, n_rows)."""
        shape = (len(points), len(self.problem.target))
        return rng.standard_normal(shape) if self.dof is None else rng.standard_t(self.dof, shape)

    def noise_factors(self, points: Floats) -> Floats | None:
        """Factors on the noise at points (..., n_unknowns), or None if the noise is as stated."""
        return None

    @property
    def log_scale(self) -> Floats:
        """Log density of each row at zero residual, shape (n_rows,)."""
        whitening = self.problem.whitening
        scale = whitening.scale if whitening.mix is None else whitening.mix.diagonal()
        return np.log(scale) + (_LOG_PEAK if self.dof is None else log_peak(self.dof))

    def _widened(self, residuals: Floats) -> Floats:
        """Residuals as charts see them, those near zero about zero."""
        if len(self._near):
            residuals = residuals.copy()
            residuals[:, self._near] = (residuals[:, self._near] + self._offset) * self._shrink
        return residuals

    def _standardised(self, rows: Floats) -> Floats:
        """The standardised residuals behind the charts' rows (n_points, n_rows)."""
        residuals = rows if self._tangent is None else self._tangent.standardised(rows)
        if len(self._near):
            residuals = residuals.copy()
            residuals[:, self._near] = residuals[:, self._near] / self._shrink - self._offset
        return residuals

    def _bent(self, standardised: Floats) -> Floats:
        return standardised if self.dof is None else bend(standardised, self.dof)[0]

    def _other_sign(self, standardised: Floats) -> Floats:
        """What the other sign adds to the log density of rows whose sign is not known."""
        # Residual s with the sign that was decided, s + 2 t with the other one.
        folded = standardised[:, self._folded]
        if self.dof is None:
            return np.logaddexp(0.0, -self._twice * (folded + 0.5 * self._twice))
        return np.logaddexp(0.0, 0.5 * self._bent(folded) ** 2 - 0.5 * self._bent(folded + self._twice) ** 2)
