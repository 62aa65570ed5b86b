"""Proposals to a posterior: charts, one around each minimum of the sum of squares, and their mixture."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.infer.posterior.target import PosteriorTarget

_MOST_ITERATIONS = 16
#: Rounding leaves about 1e-9 with nanometre noise, and the density of a proposal is right to this relative error.
_SOLVED = 1e-7
#: A point is found again if the solver ends within this of it, in prior standard deviations. Solutions that are closer
#: together lie on either side of a fold, where the determinant has another sign.
_SAME_POINT = 1e-4
_MOST_HALVINGS = 10
#: An iteration that comes no closer than this share of the distance runs against a fold: there is no solution.
_STUCK = 0.9
_AT_ONCE = 32
#: Further steps with the same slopes, which cost no derivatives, go on while each shrinks the distance to this share.
_MOST_CHORD_STEPS = 8
_FAST = 0.2


@dataclass(frozen=True)
class Solved:
    """Points that solve h(v) = e."""

    points: Floats  # shape (n_points, n)
    log_density: Floats  # of the target, unnormalised, shape (n_points,)
    log_proposal: Floats  # of the chart, shape (n_points,); minus infinity outside it
    inside: Bools  # whether the point was found, on the same side of every fold as the reference point

    def take(self, chosen: slice) -> "Solved":
        """Some of the points."""
        return Solved(self.points[chosen], self.log_density[chosen], self.log_proposal[chosen], self.inside[chosen])


def in_parts(n_points: int, step: int) -> list[slice]:
    """Points, `step` at a time."""
    return [slice(i, i + step) for i in range(0, n_points, step)]


class Proposal:
    """The map around one reference point (n,) of a target; a minimum of the sum of squares serves best."""

    def __init__(self, target: PosteriorTarget, reference: Floats) -> None:
        self.target, self.reference = target.centred(reference), reference
        residuals, jacobian = self.target.data_batch(reference[None])
        rows = np.vstack([jacobian[0], np.eye(len(reference))])
        del jacobian
        orthonormal, triangle = linalg.qr(rows, mode="economic", overwrite_a=True)
        # Positive diagonal: det Q'J is positive at the reference point.
        signs = np.where(np.diag(triangle) < 0, -1.0, 1.0)
        orthonormal *= signs
        self.log_volume = float(np.log(np.abs(np.diag(triangle))).sum())
        self._inverse = linalg.solve_triangular(triangle * signs[:, None], np.eye(len(reference)))
        self._on_data, self._on_prior = orthonormal[: -len(reference)], orthonormal[-len(reference) :]
        # Zero at a minimum, where Q'r vanishes.
        self._at_reference = residuals[0] @ self._on_data + reference @ self._on_prior

    def coordinates(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """h(v), its derivatives Q'J(v), and the target's log density at points (n_points, n)."""
        h, log_density = np.empty_like(points), np.empty(len(points))
        slopes = np.empty((*points.shape, points.shape[1]))
        # A few points at a time: their derivatives stay in the cache.
        for part in in_parts(len(points), min(_AT_ONCE, self.target.at_once)):
            residuals, jacobian = self.target.data_batch(points[part])
            h[part] = self._projected(residuals, points[part])
            np.matmul(self._on_data.T, jacobian, out=slopes[part])
            log_density[part] = self.target.log_density(residuals, points[part])
            del residuals, jacobian
        return h, slopes + self._on_prior.T, log_density

    def solve(self, normal: Floats) -> Solved:
        """Find the points that belong to standard normal coordinates (n_points, n), by damped Newton steps."""
        n_points = len(normal)
        points = self.reference + (normal - self._at_reference) @ self._inverse.T
        density, determinant = np.full(n_points, -np.inf), np.full(n_points, -np.inf)
        inside = np.zeros(n_points, dtype=bool)
        active = np.arange(n_points)
        for _ in range(_MOST_ITERATIONS):
            h, slopes, log_densities = self.coordinates(points[active])
            miss = h - normal[active]
            distance = np.linalg.norm(miss, axis=1)
            solved = distance < _SOLVED
            if solved.any():
                found = active[solved]
                sign, log_determinant = np.linalg.slogdet(slopes[solved])
                density[found], determinant[found] = log_densities[solved], log_determinant
                inside[found] = sign > 0
            # A distance that is not a number leads nowhere.
            moving = ~solved & np.isfinite(distance)
            active = active[moving]
            if not len(active):
                break
            try:
                inverse = np.linalg.inv(slopes[moving])
            except np.linalg.LinAlgError:
                # A singular one gives a step that leads nowhere.
                inverse = np.linalg.pinv(slopes[moving])
            here = points[active], normal[active], inverse, miss[moving], distance[moving]
            points[active], closer = self._advance(*here)
            active = active[closer]
        return Solved(points, density, np.where(inside, determinant + _log_normal(normal), -np.inf), inside)

    def _advance(
        self, points: Floats, normal: Floats, inverse: Floats, miss: Floats, distance: Floats
    ) -> tuple[Floats, Bools]:
        """Points after Newton steps, halved or repeated with the same slopes, and which came closer by enough."""
        before, distance, points = distance, distance.copy(), points.copy()
        step = _times(inverse, miss)
        going = np.arange(len(points))
        for attempt in range(_MOST_HALVINGS + _MOST_CHORD_STEPS):
            trial = points[going] - step[going]
            trial_miss = self._from_residuals(trial) - normal[going]
            trial_distance = np.linalg.norm(trial_miss, axis=1)
            # Written so that a distance that is not a number counts as too far.
            better = trial_distance < distance[going]
            fast = better & (trial_distance < _FAST * distance[going]) & (trial_distance > _SOLVED / 10)
            # Halve a first step that leads too far; a later one that does not pay ends the walk.
            again = going[~better & (distance[going] == before[going])] if attempt < _MOST_HALVINGS else going[:0]
            reached, onward = going[better], going[fast]
            points[reached], distance[reached] = trial[better], trial_distance[better]
            step[again] /= 2
            step[onward] = _times(inverse[onward], trial_miss[fast])
            going = np.concatenate([again, onward])
            if not len(going):
                break
        return points, distance < _STUCK * before

    def _projected(self, residuals: Floats, points: Floats) -> Floats:
        return np.asarray(residuals @ self._on_data + points @ self._on_prior)

    def _from_residuals(self, points: Floats) -> Floats:
        """h(v) without derivatives, as many points at a time as their residuals have room."""
        h, target = np.empty_like(points), self.target
        for part in in_parts(len(points), target.at_once * points.shape[1]):
            h[part] = self._projected(target.data_residuals(points[part]), points[part])
        return h

    def log_proposal(self, points: Floats) -> Floats:
        """Log density with which the chart proposes `points` (n_points, n); minus infinity outside it."""
        h, slopes, _ = self.coordinates(points)
        sign, log_determinant = np.linalg.slogdet(slopes)
        result = np.full(len(points), -np.inf)
        candidates = np.flatnonzero((sign > 0) & (np.abs(h) < 30.0).all(axis=1))
        if len(candidates):
            again = self.solve(h[candidates])
            chosen = candidates[again.inside & (np.abs(again.points - points[candidates]).max(axis=1) < _SAME_POINT)]
            result[chosen] = log_determinant[chosen] + _log_normal(h[chosen])
        return result


def _times(matrices: Floats, vectors: Floats) -> Floats:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _log_normal(normal: Floats) -> Floats:
    """Log density of the standard normal, unnormalised, shape (n_points,)."""
    return -0.5 * (normal**2).sum(axis=1)


#: A point that deserves more than this many times the proposals it gets is too rare.
_MOST_WEIGHT = 8.0
_TRIALS = 2048
_MOST_CHARTS = 4


def learn_proposals(target: PosteriorTarget, minima: Floats, rng: np.random.Generator) -> Floats:
    """Reference points of the charts, shape (n_charts, n): the minima (n_minima, n) and further points."""
    references = minima
    while len(references) < max(_MOST_CHARTS, len(minima) + 1):
        atlas = ProposalMixture(target, references)
        solved = atlas.propose(rng.standard_normal((_TRIALS, target.n_unknowns)), rng.random(_TRIALS))
        log_weights, found = np.full(_TRIALS, -np.inf), solved.inside
        log_weights[found] = solved.log_density[found] - solved.log_proposal[found]
        log_mean = special.logsumexp(log_weights) - np.log(_TRIALS)
        heaviest = int(np.argmax(log_weights))
        if log_weights[heaviest] < log_mean + np.log(_MOST_WEIGHT):
            break
        references = np.vstack([references, solved.points[heaviest]])
    return references


#: Every chart gets at least this share of the proposals, so that none of its points is rare.
LEAST_SHARE = 0.1


class ProposalMixture:
    """A mixture of charts around reference points (n_charts, n), of which the first is the lowest minimum."""

    def __init__(self, target: PosteriorTarget, references: Floats) -> None:
        self.target = target
        self.charts = [Proposal(target, reference) for reference in references]
        # Shares by the mass of each minimum in the Laplace approximation.
        density = target.log_density(target.data_residuals(references), references)
        shares = np.maximum(special.softmax(density - [chart.log_volume for chart in self.charts]), LEAST_SHARE)
        self.shares: Floats = shares / shares.sum()

    def propose(self, normal: Floats, choice: Floats) -> Solved:
        """Points of standard normal numbers (n_points, n) and uniform ones (n_points,); densities of the mixture."""
        chart_of = np.searchsorted(np.cumsum(self.shares)[:-1], choice, side="right")
        points, densities = np.empty_like(normal), np.empty(len(normal))
        own, inside = np.empty(len(normal)), np.zeros(len(normal), dtype=bool)
        for i, chart in enumerate(self.charts):
            mine = np.flatnonzero(chart_of == i)
            if len(mine):
                solved = chart.solve(normal[mine])
                points[mine], densities[mine] = solved.points, solved.log_density
                own[mine], inside[mine] = solved.log_proposal, solved.inside
        if len(self.charts) == 1:
            return Solved(points, densities, own, inside)
        parts = np.full((len(self.charts), len(normal)), -np.inf)
        found = np.flatnonzero(inside)
        for i, chart in enumerate(self.charts):
            others = found[chart_of[found] != i]
            mine = found[chart_of[found] == i]
            parts[i, mine] = own[mine]
            if len(others):
                parts[i, others] = chart.log_proposal(points[others])
        return Solved(points, densities, self._mixed(parts), inside)

    def log_proposal(self, points: Floats) -> Floats:
        """Log density with which the mixture proposes `points` (n_points, n)."""
        return self._mixed(np.array([chart.log_proposal(points) for chart in self.charts]))

    def _mixed(self, parts: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.asarray(special.logsumexp(parts + np.log(self.shares)[:, None], axis=0))
