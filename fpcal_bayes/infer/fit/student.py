"""Student-t rows as least squares: a residual bent so that half its square is minus the log density.

With s a standardised residual and nu degrees of freedom, minus the log density of s is (nu + 1) / 2 log(1 + s^2 / nu)
= g(s)^2 / 2 with g(s) = sign(s) sqrt((nu + 1) log(1 + s^2 / nu)), which is smooth and increasing. The fit takes
g(s) for the residual and knows nothing else of it. Near a point, rows that are linear in s have the same slope of the
log density and, where that is positive, the same curvature: proposals from them need no more steps than Gaussian ones.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import Solution, minimise, solution_rank
from fpcal_bayes.infer.fit.problem import Problem

#: Degrees of freedom where nothing else is asked for: outliers of any size have bounded pull.
DOF = 4.0
#: The noise with which the search for a minimum begins, over that of the rows, and its steps down.
_WIDEST, _STEPS = 100.0, 6
#: Least curvature of a tangent, over that of the Gaussian row which pulls as hard.
_LEAST_SHARE = 0.6
#: Proposals are made somewhat too wide, since the density falls off more slowly than its tangents.
_WIDER = 0.7


def bend(standardised: Floats, dof: float) -> tuple[Floats, Floats]:
    """The bent residual g(s) and its derivative, both of the shape of `standardised`."""
    square = standardised**2 / dof
    # log1p(x) / x, which is one at zero.
    ratio = np.where(square > 1e-12, np.log1p(square) / np.maximum(square, 1e-300), 1.0)
    root = np.sqrt((dof + 1.0) / dof * ratio)
    return standardised * root, (dof + 1.0) / dof / ((1.0 + square) * root)


def log_peak(dof: float) -> float:
    """Log density of a standardised residual at zero."""
    return float(special.gammaln((dof + 1.0) / 2.0) - special.gammaln(dof / 2.0) - 0.5 * np.log(dof * np.pi))


@dataclass(frozen=True)
class StudentTangent:
    """Rows a (s - s0) + b whose half square has the slope, and about the curvature, of minus the log density at s0."""

    centre: Floats  # s0 of each row, shape (n_rows,)
    gain: Floats  # a
    lift: Floats  # b

    @classmethod
    def at(cls, standardised: Floats, dof: float) -> "StudentTangent":
        """The tangents at standardised residuals (n_rows,)."""
        weight = (dof + 1.0) / (dof + standardised**2)
        curvature = weight * (dof - standardised**2) / (dof + standardised**2)
        # Beyond the inflection the density is a tail: a row there hardly counts.
        gain = np.sqrt(_WIDER * np.maximum(curvature, _LEAST_SHARE * weight))
        return cls(standardised, gain, weight * standardised / gain)

    def rows(self, standardised: Floats) -> Floats:
        """Rows at standardised residuals (..., n_rows), same shape."""
        return self.gain * (standardised - self.centre) + self.lift

    def standardised(self, rows: Floats) -> Floats:
        """Standardised residuals behind rows (..., n_rows), same shape."""
        return (rows - self.lift) / self.gain + self.centre


@dataclass(frozen=True)
class StudentProblem(Problem):
    """A problem with Student-t errors of whitened rows; of rows that share a reading, of what those before leave."""

    dof: float = DOF

    @classmethod
    def like(cls, problem: Problem, dof: float) -> "StudentProblem":
        """The same rows and prior."""
        return cls(**{name: getattr(problem, name) for name in problem.__dataclass_fields__}, dof=dof)

    def data_residuals(self, unknowns: Floats) -> Floats:
        return bend(super().data_residuals(unknowns), self.dof)[0]

    def data_batch(self, points: Floats) -> tuple[Floats, Floats]:
        residuals, jacobian = super().data_batch(points)
        bent, slope = bend(residuals, self.dof)
        return bent, slope[:, :, None] * jacobian

    _weighed_batch = data_batch


def robust_minimum(problem: StudentProblem, start: Floats) -> Solution:
    """Lowest minimum from `start` and the prior, as noise narrows (non-convexity graduated, Blake, Zisserman 1987)."""
    found = [minimise(problem, start)]
    for begin in (start, np.zeros(problem.n_unknowns)):
        unknowns = begin
        for factor in np.geomspace(_WIDEST, 1.0, _STEPS):
            unknowns = minimise(replace(problem, whitening=problem.whitening.scaled(float(factor))), unknowns).unknowns
        found.append(minimise(problem, unknowns))
    return min(found, key=solution_rank)
