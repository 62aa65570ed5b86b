"""A factor on the stated noise of all rows, as one more unknown.

The unknown is w with log(factor) = LOG_SD w and w standard normal. Where it is likeliest, and how narrowly the data
tell it, is found from the Laplace approximation of what the other unknowns leave: minima at several factors.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import Solution, minimise
from fpcal_bayes.infer.fit.problem import Problem

#: Prior of the factor: between a quarter and four times the stated noise with 95 %.
LOG_SD = float(np.log(2.0))
#: Proposed somewhat too widely, since the density of w is skewed.
_NARROWING = 0.8
_STEP = 0.05
#: Where w is looked for: factors between a thousandth and a thousand.
_RANGE = (-10.0, 10.0)


@dataclass(frozen=True)
class NoiseScale:
    """The likeliest w, and the root of the curvature that the data give there, as proposals take it."""

    reference: float
    curvature: float

    @classmethod
    def of(cls, problem: Problem, solution: Solution) -> "NoiseScale":
        """Find both for a fitted problem."""
        unknowns = solution.unknowns

        def profile(w: float) -> float:
            """Minus the log density of w with the other unknowns summed over (Laplace)."""
            nonlocal unknowns
            scaled = scaled_problem(problem, w)
            found = minimise(scaled, unknowns)
            unknowns = found.unknowns
            jacobian = scaled.jacobian(unknowns)
            volume = float(np.linalg.slogdet(jacobian.T @ jacobian)[1])
            return 0.5 * (found.sum_of_squares + volume + w**2) + len(problem.target) * LOG_SD * w

        best = float(optimize.minimize_scalar(profile, bounds=_RANGE, method="bounded", options={"xatol": 1e-4}).x)
        return cls(best, _NARROWING * _root_curvature(profile, best))

    def row(self, w: Floats) -> Floats:
        """A residual whose square, with the prior's, is lowest at the likeliest w; same shape."""
        return self.curvature * (w - self.reference) - self.reference / self.curvature


def factors(w: Floats) -> Floats:
    """Factors on the noise of unknowns w, same shape."""
    return np.exp(LOG_SD * w)


def scaled_problem[AnyProblem: Problem](problem: AnyProblem, w: float) -> AnyProblem:
    """The problem with its noise scaled."""
    return replace(problem, whitening=problem.whitening.scaled(float(np.exp(LOG_SD * w))))


def _root_curvature(profile: Callable[[float], float], at: float) -> float:
    second = (profile(at + _STEP) - 2.0 * profile(at) + profile(at - _STEP)) / _STEP**2
    # One of it is the prior's own.
    return float(np.sqrt(max(second - 1.0, 1.0)))
