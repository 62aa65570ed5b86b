"""Minima of the sum of squares: the way to one, and the second ones that the symmetry of the nominal cell hides.

Near a symmetric geometry the data depend on some direction through its square: to first order they hardly see it, and
to a minimum on one side belongs another one across. For the built-in cell and the paper's sweeps theta_2 against
alpha_5 is such a direction: from random starting points about half of the fits end on either side, often with sums of
squares that differ by less than ten.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg, optimize, special

from fpcal_bayes.core.linalg import symmetric
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.fit.spectrum import spectrum_of

#: The minimum is reached when a further Gauss-Newton step would lower the sum of squares by less than this. In units
#: of posterior standard deviations the remaining distance is its square root.
DECREMENT_TOLERANCE = 1e-9
_POLISH_STEPS = 40
#: Gauss-Newton goes on while each step shrinks the decrement at least to this share.
_FAST = 0.05
_MAX_EVALUATIONS = 400
#: A step that is shortened to less than this share is tried along the bend of the valley; length of its differences.
_CREEPS, _SHARE = 0.6, 1e-3
#: Step of differences along a gauge, in prior standard deviations; share of an sd below which its bend is left out.
_STEP, _FELT = 1e-2, 0.1


@dataclass(frozen=True)
class Solution:
    """A minimum of the sum of squares."""

    unknowns: Floats  # scaled unknowns, shape (n_unknowns,)
    sum_of_squares: float  # over data and prior rows
    converged: bool  # whether the Gauss-Newton decrement is below `DECREMENT_TOLERANCE`


def solution_rank(solution: Solution) -> float:
    """Order of solutions: the lowest first; one that did not converge must be clearly lower, as beside a saddle."""
    total = solution.sum_of_squares + (0.0 if solution.converged else MINIMUM_EXCESS)
    return total if np.isfinite(total) else np.inf


def minimise(problem: Problem, start: Floats) -> Solution:
    """Find the minimum that lies down from `start` (n_unknowns,)."""
    return polished(problem, descended(problem, start))


def descended(problem: Problem, start: Floats) -> Floats:
    """Run Levenberg-Marquardt from `start` (n_unknowns,) with the analytic Jacobian, to near a minimum."""
    # Unknowns are in prior standard deviations; scaling by the Jacobian follows the valley slowly.
    return stepped(problem, start, _MAX_EVALUATIONS, xtol=1e-10, gtol=1e-12, diag=np.ones(len(start)))[0]


def stepped(problem: Problem, start: Floats, steps: int, **settings: Any) -> tuple[Floats, float]:
    """At most so many steps of Levenberg-Marquardt: where they lead (n_unknowns,), and the sum of squares there."""
    # `least_squares` calls the same routine of MINPACK, and takes half as long again.
    unknowns, _, found, _, _ = optimize.leastsq(
        problem.residuals, start, Dfun=problem.jacobian, full_output=True, ftol=1e-6, maxfev=steps, **settings
    )
    return unknowns, float(found["fvec"] @ found["fvec"])


def polished(problem: Problem, unknowns: Floats) -> Solution:
    """From a point near a minimum to the minimum itself: Gauss-Newton, Newton steps where it is slow."""
    residuals = problem.residuals(unknowns)
    total = float(residuals @ residuals)
    step, decrement = gauss_newton(problem, unknowns, residuals)
    newton = False
    # What rounding leaves of the decrement grows with the number of rows.
    enough = 1e-3 * DECREMENT_TOLERANCE * max(1.0, len(residuals) / 100.0)
    for _ in range(_POLISH_STEPS):
        if not np.isfinite(total) or decrement < enough:
            break
        if newton:
            step = newton_step(problem, unknowns, residuals)
        bend = np.zeros_like(step)
        candidate, candidate_residuals, candidate_total = _shortened(problem, unknowns, step, bend, total)
        if newton and np.linalg.norm(candidate - unknowns) < _CREEPS * np.linalg.norm(step):
            around = _shortened(problem, unknowns, step, _bend(problem, unknowns, residuals, step), total)
            if around[2] < candidate_total:
                candidate, candidate_residuals, candidate_total = around
        if candidate_total > total:
            # Not even a short step goes down: rounding, or Gauss-Newton misled by curvature.
            if newton:
                break
            newton = True
            continue
        unknowns, residuals, total = candidate, candidate_residuals, candidate_total
        last = decrement
        step, decrement = gauss_newton(problem, unknowns, residuals)
        newton = decrement > _FAST * last
    # Standard deviations are judged against the scatter that is there: a poor fit has no digits beyond it.
    tolerance = DECREMENT_TOLERANCE * max(1.0, total / len(residuals))
    return Solution(unknowns, total, bool(np.isfinite(total) and decrement < tolerance))


def _bend(problem: Problem, unknowns: Floats, residuals: Floats, step: Floats) -> Floats:
    """How a curved valley turns away from a step in it: the geodesic acceleration of Transtrum and Sethna (2012)."""
    width = _SHARE / max(float(np.linalg.norm(step)), _SHARE)
    ahead, behind = (problem.residuals(unknowns + sign * width * step) for sign in (1.0, -1.0))
    jacobian = problem.jacobian(unknowns)
    return np.asarray(-linalg.lstsq(jacobian, (ahead - 2.0 * residuals + behind) / width**2, check_finite=False)[0])


def _shortened(
    problem: Problem, unknowns: Floats, step: Floats, bend: Floats, total: float
) -> tuple[Floats, Floats, float]:
    """The step along its bend, halved until the sum of squares does not grow (or eight times)."""
    for _ in range(8):
        candidate = unknowns + step + bend / 2.0
        residuals = problem.residuals(candidate)
        candidate_total = float(residuals @ residuals)
        # The last digits of the sum are rounding: equal within them counts as no worse.
        if candidate_total <= total * (1 + 1e-13):
            return candidate, residuals, min(candidate_total, total)
        step, bend = step / 2.0, bend / 4.0
    return candidate, residuals, np.inf


def newton_step(problem: Problem, unknowns: Floats, residuals: Floats) -> Floats:
    """Newton step with the Hessian by differences of the gradient J'r; its eigenvalues by size: it goes down."""
    width = 1e-4
    shifts = width * np.eye(len(unknowns))
    ahead, behind = np.split(problem.gradients(unknowns + np.concatenate([shifts, -shifts])), 2)
    eigenvalues, vectors = linalg.eigh(symmetric((ahead - behind) / (2 * width)))
    gradient = problem.jacobian(unknowns).T @ residuals
    step: Floats = -vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(eigenvalues), 1e-3))
    length = float(np.linalg.norm(step))
    return step if length <= 1.0 else step / length


def gauss_newton(problem: Problem, unknowns: Floats, residuals: Floats) -> tuple[Floats, float]:
    """The Gauss-Newton step (n_unknowns,) and by how much it would lower the linearised sum of squares."""
    orthonormal, triangle = linalg.qr(problem.jacobian(unknowns), mode="economic", check_finite=False)
    along = orthonormal.T @ residuals
    step: Floats = -linalg.solve_triangular(triangle, along, check_finite=False)
    return step, float(along @ along)


_MOST_IMAGES = 3
#: Minima within this of the lowest sum of squares belong to the posterior.
MINIMUM_EXCESS = 30.0


def sign_images(problem: Problem, solution: Solution) -> list[Floats]:
    """Points (n_unknowns,) across the directions that the data see at `solution` and at the prior mean less than it."""
    n, unknowns = problem.n_free, solution.unknowns
    at_mean = spectrum_of(problem.data_jacobian(np.zeros(problem.n_unknowns))[:, :n])
    here = spectrum_of(problem.data_jacobian(unknowns)[:, :n])
    weak = at_mean.observable[at_mean.singular_values[: at_mean.rank] < 1.0]
    # Of the directions invisible at the mean, those farthest from the invisible ones here; gauges only bend a little.
    n_hidden = max(here.rank - at_mean.rank, 0)
    outside = at_mean.null_space - (at_mean.null_space @ here.null_space.T) @ here.null_space
    hidden = linalg.svd(outside)[0].T[:n_hidden] @ at_mean.null_space if n_hidden else np.zeros((0, n))
    images = []
    for direction in [*weak[::-1], *hidden][:_MOST_IMAGES]:
        image = unknowns.copy()
        image[:n] -= 2.0 * (direction @ unknowns[:n]) * direction
        images.append(image)
    return images


def distinct_minima(problem: Problem, best: Solution, found: list[Solution]) -> tuple[Solution, ...]:
    """Minima other than the lowest one that count for the posterior, lowest first, each away from the others."""
    jacobian = problem.jacobian(best.unknowns)
    others: list[Solution] = []
    for other in sorted(found, key=solution_rank):
        apart = [jacobian @ (other.unknowns - known.unknowns) for known in (best, *others)]
        if (
            other.converged
            and other.sum_of_squares - best.sum_of_squares < MINIMUM_EXCESS
            and min(float(distance @ distance) for distance in apart) > 1.0
        ):
            others.append(other)
    return tuple(others)


def all_minima(problem: Problem, solution: Solution) -> tuple[Solution, ...]:
    """The minimum `solution` and those across the hidden symmetries that count, lowest first."""
    found = [solution, *(minimise(problem, image) for image in sign_images(problem, solution))]
    best = min(found, key=solution_rank)
    return (best, *distinct_minima(problem, best, found))


def spread_over(problem: Problem, covariance: Floats, solution: Solution, others: Sequence[Solution]) -> Floats:
    """Second moments around the lowest minimum over all that count, by their Laplace weights, shape as `covariance`."""
    if not others:
        return covariance
    n, minima = problem.n_free, (solution, *others)
    own = [problem.covariance(minimum.unknowns) for minimum in minima]
    volumes = [np.linalg.slogdet(each[:n, :n])[1] for each in own]
    weights = special.softmax(0.5 * np.array([v - m.sum_of_squares for v, m in zip(volumes, minima, strict=True)]))
    away = np.zeros((len(minima), len(covariance)))
    away[:, :n] = [problem.values(minimum.unknowns)[:n] - problem.values(solution.unknowns)[:n] for minimum in minima]
    return np.asarray(np.tensordot(weights, np.array([covariance, *own[1:]]) + away[:, :, None] * away[:, None], 1))


def curve_sd(problem: Problem, unknowns: Floats, covariance: Floats) -> Floats:
    """What gauges add by their bend to the standard deviations of a `covariance`, in um and rad (n_free,)."""
    n, rows = problem.n_free, len(problem.target)
    unseen = spectrum_of(problem.data_jacobian(unknowns)[:, :n]).null_space
    orthonormal, triangle = linalg.qr(problem.jacobian(unknowns), mode="economic", overwrite_a=True)
    curve = np.zeros((len(unseen), n, len(unseen)))
    for each, gauge in zip(curve, _STEP * np.pad(unseen, ((0, 0), (0, problem.n_unknowns - n))), strict=True):
        ahead, behind = (problem.data_jacobian(unknowns + way)[:, :n] @ unseen.T for way in (gauge, -gauge))
        # What keeps the rows as they are, to second order, while the scores along the gauges are standard normal.
        moved = orthonormal[:rows].T @ (ahead - behind) / (2.0 * _STEP)
        each[:] = problem.prior.slopes(unknowns[:n]) @ -linalg.solve_triangular(triangle, moved)[:n]
    # The mean square of half a quadratic form, whose mean the estimate, at the mode, lacks.
    square = 0.5 * (curve**2).sum(axis=(0, 2)) + 0.25 * np.einsum("knk->n", curve) ** 2
    return np.where(square > _FELT**2 * np.diag(covariance)[:n], np.sqrt(square), 0.0)
