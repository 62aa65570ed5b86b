"""A chart: the map that straightens the posterior around one point (randomise-then-optimise).

With the rows r(v) of data and prior, their Jacobian J0 = Q R at a reference point v0, and h(v) = Q'(r(v) - r(v0)), a
standard normal e is turned into the point v that solves h(v) = e. Where the map is one to one, v has the density
|det Q'J(v)| N(h(v); 0, I), which is the posterior itself but for the part of r that Q does not see (Bardsley, Solonen,
Haario, Laine 2014).

The map may fold. Points from which the solver does not come back to themselves are outside the chart: it never proposes
them, and says so with a density of zero, which keeps a Metropolis step exact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fpcal_bayes.infer.posterior.target import Target

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MOST_ITERATIONS = 16
_SOLVED = 1e-9
#: A point is found again if the solver ends within this of it, in prior standard deviations.
_SAME_POINT = 1e-6


@dataclass(frozen=True)
class Solved:
    """Points that solve h(v) = e.

    Attributes
    ----------
    points
        Shape (n_points, n).
    log_density
        Of the target, unnormalised, shape (n_points,).
    log_proposal
        Of the chart, shape (n_points,); minus infinity outside it.
    inside
        Whether the point was found, on the same side of every fold as the reference point.
    """

    points: Floats
    log_density: Floats
    log_proposal: Floats
    inside: Bools


class Chart:
    """The map around one reference point of a target.

    Parameters
    ----------
    target
        The density.
    reference
        Shape (n,); a minimum of the sum of squares serves best.
    """

    def __init__(self, target: Target, reference: Floats) -> None:
        self.target, self.reference = target, reference
        residuals, jacobian = target.data_batch(reference[None])
        rows = np.vstack([jacobian[0], np.eye(len(reference))])
        orthonormal, triangle = linalg.qr(rows, mode="economic")
        # Positive diagonal: det Q'J is positive at the reference point.
        signs = np.where(np.diag(triangle) < 0, -1.0, 1.0)
        orthonormal = orthonormal * signs
        self.log_volume = float(np.log(np.abs(np.diag(triangle))).sum())
        self._inverse = linalg.solve_triangular(triangle * signs[:, None], np.eye(len(reference)))
        self._on_data, self._on_prior = orthonormal[: -len(reference)], orthonormal[-len(reference) :]
        self._offset = residuals[0] @ self._on_data + reference @ self._on_prior

    def coordinates(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """h(v), its derivatives Q'J(v), and the target's log density at points (n_points, n)."""
        residuals, jacobian = self.target.data_batch(points)
        h = residuals @ self._on_data + points @ self._on_prior - self._offset
        return h, self._on_data.T @ jacobian + self._on_prior.T, self.target.log_density(residuals, points)

    def solve(self, normal: Floats) -> Solved:
        """Find the points that belong to standard normal coordinates (n_points, n), by damped Newton steps."""
        n_points = len(normal)
        points = self.reference + normal @ self._inverse.T
        density, determinant = np.full(n_points, -np.inf), np.full(n_points, -np.inf)
        inside = np.zeros(n_points, dtype=bool)
        step, best = np.zeros_like(points), np.full(n_points, np.inf)
        active = np.arange(n_points)
        for _ in range(_MOST_ITERATIONS):
            h, slopes, log_densities = self.coordinates(points[active])
            miss = h - normal[active]
            distance = np.linalg.norm(miss, axis=1)
            # Written so that a distance that is not a number counts as too far.
            closer = distance < best[active]
            solved = closer & (distance < _SOLVED)
            if solved.any():
                found = active[solved]
                sign, log_determinant = np.linalg.slogdet(slopes[solved])
                density[found], determinant[found] = log_densities[solved], log_determinant
                inside[found] = sign > 0
            moving = closer & ~solved
            ahead = active[moving]
            best[ahead] = distance[moving]
            step[ahead] = -_solve_each(slopes[moving], miss[moving])
            points[ahead] += step[ahead]
            # Too far: back by half of the last step.
            behind = active[~closer]
            step[behind] /= 2
            points[behind] -= step[behind]
            active = active[~solved]
            if not len(active):
                break
        proposal = np.where(inside, determinant + _log_normal(normal), -np.inf)
        return Solved(points, density, proposal, inside)

    def log_proposal(self, points: Floats) -> Floats:
        """Log density with which the chart proposes `points` (n_points, n); minus infinity outside it."""
        h, slopes, _ = self.coordinates(points)
        sign, log_determinant = np.linalg.slogdet(slopes)
        result = np.full(len(points), -np.inf)
        candidates = np.flatnonzero((sign > 0) & (np.abs(h) < 30.0).all(axis=1))
        if len(candidates):
            again = self.solve(h[candidates])
            same = again.inside & (np.abs(again.points - points[candidates]).max(axis=1) < _SAME_POINT)
            chosen = candidates[same]
            result[chosen] = log_determinant[chosen] + _log_normal(h[chosen])
        return result


def _solve_each(slopes: Floats, right: Floats) -> Floats:
    """Solve one linear system a point; a singular one gives a step that leads nowhere."""
    try:
        return np.linalg.solve(slopes, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(slopes, right, strict=True)])


def _log_normal(normal: Floats) -> Floats:
    """Log density of the standard normal, unnormalised, shape (n_points,)."""
    result: Floats = -0.5 * (normal**2).sum(axis=1)
    return result
