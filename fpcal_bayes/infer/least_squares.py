"""Minimise a whitened problem: Levenberg-Marquardt, then Gauss-Newton steps to the last digit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from fpcal_bayes.infer.problem import Problem

Floats = NDArray[np.float64]

#: The minimum is reached when a further Gauss-Newton step would lower the sum of squares by less than this. In units
#: of posterior standard deviations the remaining distance is its square root.
DECREMENT_TOLERANCE = 1e-9
_POLISH_STEPS = 40
#: Gauss-Newton goes on while each step shrinks the decrement at least to this share.
_FAST = 0.05
_MAX_EVALUATIONS = 400


@dataclass(frozen=True)
class Solution:
    """A minimum of the sum of squares.

    Attributes
    ----------
    unknowns
        Scaled unknowns, shape (n_unknowns,).
    sum_of_squares
        Over data and prior rows.
    converged
        Whether the Gauss-Newton decrement is below `DECREMENT_TOLERANCE`.
    """

    unknowns: Floats
    sum_of_squares: float
    converged: bool


def solution_rank(solution: Solution) -> tuple[bool, float]:
    """Order of solutions: converged ones first, then the lowest."""
    return not solution.converged, solution.sum_of_squares


def minimise(problem: Problem, start: Floats) -> Solution:
    """Run Levenberg-Marquardt from `start` (n_unknowns,) with the analytic Jacobian."""
    found = optimize.least_squares(
        problem.residuals,
        start,
        problem.jacobian,
        method="lm",
        x_scale=1.0,  # unknowns are in prior standard deviations; scaling by the Jacobian follows the valley slowly
        ftol=1e-6,
        xtol=1e-10,
        gtol=1e-12,
        max_nfev=_MAX_EVALUATIONS,
    )
    return polished(problem, found.x)


def polished(problem: Problem, unknowns: Floats) -> Solution:
    """Go from a point near a minimum to the minimum itself.

    Gauss-Newton steps as long as they contract fast; where the curvature of the model slows them down, Newton steps
    with the full second derivatives.
    """
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
        candidate, candidate_residuals, candidate_total = _shortened(problem, unknowns, step, total)
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


def _shortened(problem: Problem, unknowns: Floats, step: Floats, total: float) -> tuple[Floats, Floats, float]:
    """The step, halved until the sum of squares does not grow (or eight times)."""
    for _ in range(8):
        candidate = unknowns + step
        residuals = problem.residuals(candidate)
        candidate_total = float(residuals @ residuals)
        # The last digits of the sum are rounding: equal within them counts as no worse.
        if candidate_total <= total * (1 + 1e-13):
            return candidate, residuals, min(candidate_total, total)
        step = step / 2
    return candidate, residuals, np.inf


def newton_step(problem: Problem, unknowns: Floats, residuals: Floats) -> Floats:
    """Newton step (n_unknowns,) with the Hessian by central differences of the gradient J'r.

    Where the Hessian is not positive definite its eigenvalues are taken by size, so that the step goes down.
    """
    width = 1e-4
    shifts = width * np.eye(len(unknowns))
    ahead, behind = np.split(problem.gradients(unknowns + np.concatenate([shifts, -shifts])), 2)
    hessian = (ahead - behind) / (2 * width)
    eigenvalues, vectors = linalg.eigh((hessian + hessian.T) / 2)
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
