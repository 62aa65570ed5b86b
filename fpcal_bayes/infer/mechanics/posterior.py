"""The exact posterior of geometry and scales: the mechanics marginalised, nothing else linearised.

The weights are marginalised where they are linear, at the fit's own design matrix; the geometry stays nonlinear, the
scales are unknowns. A draw is made in two steps: scales from what the linearised problem says of them, then a geometry
by randomise-then-optimise under the covariance C of these scales. With h(v) = Q'r(v), r the rows whitened under C and
the prior rows, Q from the Jacobian's QR at a reference, the geometry that solves h(v) = e, e standard normal, has the
density |det Q'J(v)| N(e; 0, I). The pair is weighed by

    N(y - f(v); 0, C(s)) N(v) p(s) / (p_linear(s) |det Q'J(v)| N(e; 0, I)),

p_linear(s) being known but for a constant: the weighted draws (or a Metropolis chain with these proposals) are exact.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.mechanics.scales import independent_scales

_ITERATIONS, _SOLVED = 14, 1e-7
#: Coordinates beyond this are in no chart; a point is found again if it is solved within this of it.
_FARTHEST, _SAME_POINT = 30.0, 1e-4
#: Scales that are worked on together, and geometries drawn for each.
_TOGETHER, _PER_SCALE = 25, 8


@dataclass(frozen=True)
class WeightedDraws:
    """Draws of geometry and scales with their weights.

    Attributes
    ----------
    scores
        Standard normal scores of the geometry, shape (n_draws, n_unknowns).
    log_scales
        Shape (n_draws, n_scales).
    log_weights
        Unnormalised, minus infinity where there was no solution, shape (n_draws,).
    """

    scores: Floats
    log_scales: Floats
    log_weights: Floats

    @property
    def weights(self) -> Floats:
        """Normalised weights, shape (n_draws,)."""
        weights = np.exp(self.log_weights - self.log_weights.max())
        result: Floats = weights / weights.sum()
        return result

    @property
    def effective(self) -> float:
        """How many independent draws they are worth."""
        return float(1.0 / (self.weights**2).sum())

    @property
    def solved(self) -> float:
        """Share of draws that had a solution; the rest stands for mass beyond a fold."""
        return float(np.isfinite(self.log_weights).mean())

    def metropolis(self, rng: np.random.Generator) -> Ints:
        """Positions of the draws that a Metropolis chain stands on, which proposes them one after the other."""
        places = np.empty(len(self.log_weights), dtype=np.int64)
        at = int(np.argmax(np.isfinite(self.log_weights)))
        for i, uniform in enumerate(np.log(rng.random(len(places)))):
            if uniform < self.log_weights[i] - self.log_weights[at]:
                at = i
            places[i] = at
        return places


class ScaleCharts:
    """Maps that straighten the posterior of the geometry, one per set of scales.

    Parameters
    ----------
    fit
        Whose geometry is the reference point.
    log_scales
        Shape (n_charts, n_scales).
    reference
        Point that the maps are made around, shape (n_unknowns,); by default the fit's own minimum.
    covariance
        Of the fit's rows, by default made anew.
    """

    def __init__(
        self,
        fit: MechanicsFit,
        log_scales: Floats,
        reference: Floats | None = None,
        covariance: "RowCovariance | None" = None,
    ) -> None:
        self.fit, self.log_scales = fit, log_scales
        reference = fit.solution.unknowns if reference is None else reference
        problem, self.reference = fit.problem, reference
        residuals, jacobian = _rows(fit, reference[None])
        n, size = len(reference), (len(log_scales), len(reference))
        self.whiten = np.empty((len(log_scales), len(problem.target), len(problem.target)))
        self.on_data, self.on_prior = np.empty((*size, len(problem.target))), np.empty((*size, n))
        self.inverse, self.begin, self.log_volume = np.empty((*size, n)), np.empty(size), np.empty(len(log_scales))
        covariance = RowCovariance(fit) if covariance is None else covariance
        self.log_determinant = np.empty(len(log_scales))
        for k, log in enumerate(log_scales):
            lower = covariance.factor(log)
            inverse = linalg.lapack.dtrtri(lower, lower=1)[0]
            self.log_determinant[k] = np.log(np.diag(lower)).sum()
            orthonormal, triangle = linalg.qr(np.vstack([inverse @ jacobian[0], np.eye(n)]), mode="economic")
            signs = np.where(np.diag(triangle) < 0, -1.0, 1.0)
            orthonormal, triangle = orthonormal * signs, triangle * signs[:, None]
            self.whiten[k] = inverse
            self.on_data[k] = orthonormal[:-n].T @ inverse
            self.on_prior[k] = orthonormal[-n:].T
            self.inverse[k] = linalg.solve_triangular(triangle, np.eye(n))
            self.begin[k] = self.on_data[k] @ residuals[0] + self.on_prior[k] @ reference

    @classmethod
    def joined(cls, charts: Sequence["ScaleCharts"]) -> "ScaleCharts":
        """Several sets of charts around one reference as one."""
        made = copy.copy(charts[0])
        for name in ("log_scales", "whiten", "on_data", "on_prior", "inverse", "begin", "log_determinant"):
            setattr(made, name, np.concatenate([getattr(part, name) for part in charts]))
        return made

    def at(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """At one point per chart (n_charts, n): coordinates, sign and log of the determinant, log density (n_charts,).

        The density is that of the geometry given the scales, without the prior of the scales.
        """
        residuals, jacobian = _rows(self.fit, points)
        h = (self.on_data @ residuals[:, :, None] + self.on_prior @ points[:, :, None])[:, :, 0]
        sign, log_determinant = np.linalg.slogdet(self.on_data @ jacobian + self.on_prior)
        white = (self.whiten @ residuals[:, :, None])[:, :, 0]
        log_density = -0.5 * (white**2).sum(axis=1) - self.log_determinant - 0.5 * (points**2).sum(axis=1)
        return h, sign, log_determinant, log_density

    def log_proposal(self, points: Floats) -> Floats:
        """Log density with which each chart proposes its point (n_charts, n); minus infinity outside the chart."""
        h, sign, log_determinant, _ = self.at(points)
        result = np.full(len(points), -np.inf)
        inside = (sign > 0) & (np.abs(h) < _FARTHEST).all(axis=1)
        if inside.any():
            again, weights = self.solve(np.where(inside[:, None], h, 0.0)[:, None])
            same = np.isfinite(weights[:, 0]) & (np.abs(again[:, 0] - points).max(axis=1) < _SAME_POINT)
            found = inside & same
            result[found] = log_determinant[found] - 0.5 * (h[found] ** 2).sum(axis=1)
        return result

    def solve(self, normal: Floats) -> tuple[Floats, Floats]:
        """Geometries of standard normal coordinates (n_charts, n_each, n), and their log weights (n_charts, n_each)."""
        fit, shape, reference = self.fit, normal.shape, self.reference
        points = reference + np.einsum("kij,kbj->kbi", self.inverse, normal - self.begin[:, None])
        log_weights = np.full(shape[:2], -np.inf)
        active = np.argwhere(np.ones(shape[:2], dtype=bool))
        last = np.full(shape[:2], np.inf)
        for _ in range(_ITERATIONS):
            k, b = active.T
            residuals, jacobian = _rows(fit, points[k, b])
            # The same maps again and again: a product per draw of 21 x rows with rows x 21.
            h = (self.on_data[k] @ residuals[:, :, None] + self.on_prior[k] @ points[k, b][:, :, None])[:, :, 0]
            slopes = self.on_data[k] @ jacobian + self.on_prior[k]
            miss = h - normal[k, b]
            distance = np.linalg.norm(miss, axis=1)
            solved = distance < _SOLVED
            if solved.any():
                ks, bs = k[solved], b[solved]
                sign, log_determinant = np.linalg.slogdet(slopes[solved])
                white = (self.whiten[ks] @ residuals[solved][:, :, None])[:, :, 0]
                log_density = -0.5 * (white**2).sum(axis=1) - self.log_determinant[ks]
                log_density -= 0.5 * (points[ks, bs] ** 2).sum(axis=1)
                log_proposal = log_determinant - 0.5 * (normal[ks, bs] ** 2).sum(axis=1)
                log_weights[ks, bs] = np.where(sign > 0, log_density - log_proposal, -np.inf)
            going = ~solved & np.isfinite(distance) & (distance < 2.0 * last[k, b])
            last[k, b] = distance
            if not going.any():
                break
            step = np.linalg.solve(slopes[going], miss[going][:, :, None])[:, :, 0]
            points[k[going], b[going]] -= step
            active = active[going]
        return points, log_weights


def weighted_draws(fit: MechanicsFit, n_draws: int, *, seed: int = 0) -> WeightedDraws:
    """Draw geometry and scales from their exact posterior, with weights."""
    rng = np.random.default_rng([seed, 3])
    n_scales = -(-n_draws // _PER_SCALE)
    log_scales, log_linear = independent_scales(fit.density, fit.scales.mode, n_scales, rng)
    prior = -0.5 * ((log_scales / fit.density.prior_sd) ** 2).sum(axis=1)
    scores, weights = [], []
    n = fit.problem.n_unknowns
    for first in range(0, n_scales, _TOGETHER):
        part = slice(first, first + _TOGETHER)
        charts = ScaleCharts(fit, log_scales[part])
        points, log_weights = charts.solve(rng.standard_normal((len(log_scales[part]), _PER_SCALE, n)))
        scores.append(points.reshape(-1, n))
        weights.append((log_weights + (prior - log_linear)[part, None]).ravel())
    return WeightedDraws(np.concatenate(scores), np.repeat(log_scales, _PER_SCALE, axis=0), np.concatenate(weights))


class RowCovariance:
    """C(s), that of the rows given the geometry."""

    def __init__(self, fit: MechanicsFit) -> None:
        self._readings, self._returns = fit.noise.dense()
        self._design = fit.design

    def factor(self, log: Floats) -> Floats:
        """Lower Cholesky factor."""
        factors = np.exp(log)
        columns = self._design.matrix * factors[self._design.scale]
        total = columns @ columns.T + factors[-1] ** 2 * self._readings + factors[-2] ** 2 * self._returns
        return np.linalg.cholesky(total)


def _rows(fit: MechanicsFit, points: Floats) -> tuple[Floats, Floats]:
    """Predicted minus measured (n_points, n_rows) and derivatives by the scores (n_points, n_rows, n)."""
    return fit.problem._unwhitened_batch(points)
