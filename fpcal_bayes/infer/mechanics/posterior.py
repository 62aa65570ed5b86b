"""The exact posterior of geometry and scales: the mechanics marginalised, nothing else linearised.

The weights are marginalised where they are linear, at the fit's own design matrix; the geometry stays nonlinear, the
scales are unknowns. Given scales s the rows have the covariance C(s), and a geometry is drawn by randomise-then-
optimise: with J the Jacobian at a reference, L L' = I + J'C^-1 J and

    h(v) = L^-1 (J'C^-1 r(v) + v),

the geometry that solves h(v) = e, e standard normal, has the density |det h'(v)| N(e; 0, I). It is weighed by the
density of the rows, N(y - f(v); 0, C(s)) N(v): a Metropolis chain with these proposals is exact.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import lapack

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.infer.fit.problem import Problem

_ITERATIONS, _SOLVED = 14, 1e-7
#: Coordinates beyond this are in no chart; a point is found again if it is solved within this of it.
_FARTHEST, _SAME_POINT = 30.0, 1e-4


class ScaleCharts:
    """Maps that straighten the posterior of the geometry, one per set of scales.

    problem: whose rows are predicted; its whitening is not looked at.
    reference: point that the maps are made around, shape (n_unknowns,).
    factors: lower Cholesky factor of C(s) for each set of scales; what stands above the diagonal is not read.
    """

    def __init__(self, problem: Problem, reference: Floats, factors: Sequence[Floats]) -> None:
        self.problem, self.reference, self.factors = problem, reference, list(factors)
        residuals, jacobian = problem.unwhitened_batch(reference[None])
        n = len(reference)
        self.on_data = np.empty((len(factors), n, len(problem.target)))
        self.on_prior, self.begin = np.empty((len(factors), n, n)), np.empty((len(factors), n))
        self.log_determinant = np.empty(len(factors))
        for k, lower in enumerate(factors):
            white = lapack.dtrtrs(lower, jacobian[0], lower=1)[0]
            root = np.linalg.cholesky(np.eye(n) + white.T @ white)
            weighed = lapack.dtrtrs(lower, white, lower=1, trans=1)[0]
            self.on_prior[k] = lapack.dtrtri(root, lower=1)[0]
            self.on_data[k] = self.on_prior[k] @ weighed.T
            self.begin[k] = self.on_data[k] @ residuals[0] + self.on_prior[k] @ reference
            self.log_determinant[k] = np.log(lower.diagonal()).sum()

    @classmethod
    def joined(cls, charts: Sequence["ScaleCharts"]) -> "ScaleCharts":
        """Several sets of charts around one reference as one."""
        made = cls.__new__(cls)
        made.problem, made.reference = charts[0].problem, charts[0].reference
        made.factors = [factor for part in charts for factor in part.factors]
        for name in ("on_data", "on_prior", "begin", "log_determinant"):
            setattr(made, name, np.concatenate([getattr(part, name) for part in charts]))
        return made

    def log_density(self, points: Floats) -> Floats:
        """Log density of one geometry per chart (n_charts, n), without the prior of the scales."""
        return self._log_density(np.arange(len(points)), points, self.problem.unwhitened_batch(points)[0])

    def log_proposal(self, points: Floats) -> Floats:
        """Log density with which each chart proposes its point (n_charts, n); minus infinity outside the chart."""
        h, slopes, _ = self._at(np.arange(len(points)), points)
        sign, log_determinant = np.linalg.slogdet(slopes)
        inside = (sign > 0) & (np.abs(h) < _FARTHEST).all(axis=1)
        result = np.full(len(points), -np.inf)
        if inside.any():
            again, _, log_again = self.solve(h, inside)
            found = inside & np.isfinite(log_again) & (np.abs(again - points).max(axis=1) < _SAME_POINT)
            result[found] = log_determinant[found] - 0.5 * (h[found] ** 2).sum(axis=1)
        return result

    def solve(self, normal: Floats, asked: Bools | None = None) -> tuple[Floats, Floats, Floats]:
        """Geometries of standard normal coordinates, one per chart (n_charts, n), of the charts that are `asked`.

        Returns the geometries (n_charts, n), their log density and the log density with which they are proposed
        (n_charts,), both minus infinity where there is no solution on the reference's side of every fold.
        """
        # The triangle's inverse is the transpose of what stands before the prior rows.
        points = self.reference + np.einsum("kji,kj->ki", self.on_prior, normal - self.begin)
        log_density, log_proposal = np.full((2, len(normal)), -np.inf)
        active = np.arange(len(normal)) if asked is None else np.flatnonzero(asked)
        last = np.full(len(normal), np.inf)
        for _ in range(_ITERATIONS):
            h, slopes, residuals = self._at(active, points[active])
            miss = h - normal[active]
            distance = np.linalg.norm(miss, axis=1)
            solved = distance < _SOLVED
            if solved.any():
                found = active[solved]
                sign, log_determinant = np.linalg.slogdet(slopes[solved])
                density = self._log_density(found, points[found], residuals[solved])
                proposal = log_determinant - 0.5 * (normal[found] ** 2).sum(axis=1)
                log_density[found] = np.where(sign > 0, density, -np.inf)
                log_proposal[found] = np.where(sign > 0, proposal, -np.inf)
            going = ~solved & np.isfinite(distance) & (distance < 2.0 * last[active])
            last[active] = distance
            active = active[going]
            if not len(active):
                break
            points[active] -= np.linalg.solve(slopes[going], miss[going][:, :, None])[:, :, 0]
        return points, log_density, log_proposal

    def _at(self, charts: Ints, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Coordinates and their derivatives of `points` (n, n_unknowns) in `charts` (n,), and the rows' residuals."""
        residuals, jacobian = self.problem.unwhitened_batch(points)
        on_data, on_prior = self.on_data[charts], self.on_prior[charts]
        h: Floats = (on_data @ residuals[:, :, None] + on_prior @ points[:, :, None])[:, :, 0]
        return h, on_data @ jacobian + on_prior, residuals

    def _log_density(self, charts: Ints, points: Floats, residuals: Floats) -> Floats:
        white = [lapack.dtrtrs(self.factors[k], r, lower=1)[0] for k, r in zip(charts, residuals, strict=True)]
        squares = np.array([float(w @ w) for w in white])
        return np.asarray(-0.5 * (squares + (points**2).sum(axis=1)) - self.log_determinant[charts])
