"""Second minima that the symmetry of the nominal cell hides.

Near a symmetric geometry the data depend on some direction through its square: to first order they hardly see it, and
to a minimum on one side belongs another one across. For the built-in cell and the paper's sweeps theta_2 against
alpha_5 is such a direction: from random starting points about half of the fits end on either side, often with sums of
squares that differ by less than ten.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fpcal_bayes.infer.least_squares import Solution, minimise, solution_rank
from fpcal_bayes.infer.observability import spectrum_of
from fpcal_bayes.infer.problem import Problem

Floats = NDArray[np.float64]

_MOST_IMAGES = 3
#: Minima within this of the lowest sum of squares belong to the posterior.
MINIMUM_EXCESS = 30.0


def mirror_images(problem: Problem, solution: Solution) -> list[Floats]:
    """Points across the directions that the data see at `solution` but hardly at the prior mean.

    Hardly means: they tell less than the prior (singular value below one), or nothing.

    Returns
    -------
    list of ndarray
        Starting points for further fits, each of shape (n_unknowns,); empty where there is no such direction.
    """
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
    found = [solution, *(minimise(problem, image) for image in mirror_images(problem, solution))]
    best = min(found, key=solution_rank)
    return (best, *distinct_minima(problem, best, found))
