"""Profile likelihoods: how far one parameter can move if all others follow as well as they can.

The others follow with their prior rows, which keep the fit on the ground of the model; what is profiled is the sum of
squares of the data alone, so that a prior never makes a parameter look identified.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import optimize, special

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import Solution, minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.model.cavity import CavityModel

Shape = Literal["finite", "one-sided", "flat"]


@dataclass(frozen=True)
class Profile:
    """Profile of one parameter."""

    name: str
    # values, excess: parameter in um or rad, ascending, and growth of the data's sum of squares over its lowest; shape
    # (n_points,)
    values: Floats
    excess: Floats
    # low, high: where the excess passes the threshold; infinite where it does not within the reach
    low: float
    high: float
    shape: Shape  # ``finite`` (both ends), ``one-sided`` or ``flat`` (neither)
    level: float  # confidence level of the interval


def profile(problem: Problem, solution: Solution, name: str, *, level: float = 0.95, reach: float = 5.0) -> Profile:
    """Profile one parameter by re-optimising all others (Raue et al. 2009).

    `level` is the confidence level of the interval, `reach` how far to go from the maximum, in prior standard
    deviations.
    """
    position = problem.model.free.position(name)
    threshold = 2.0 * float(special.gammaincinv(0.5, level))
    prior_sd = problem.prior.sd[position]
    centre = problem.values(solution.unknowns)[position]
    others = np.delete(np.arange(problem.n_unknowns), position)
    track = _Track(problem, position, solution.unknowns[others])
    # The lowest point of the profile lies off the maximum of the posterior, which has prior rows.
    sd = float(np.sqrt(problem.covariance(solution.unknowns)[position, position]))
    points = {centre: track.data_squares(centre)}
    ends = {}
    for side in (-1.0, 1.0):
        track.restart(solution.unknowns[others])
        ends[side] = _walk(track, points, centre, side * min(sd, prior_sd) / 2, reach * prior_sd, threshold)
    values = np.array(sorted(points))
    totals = np.array([points[v] for v in values])
    lowest = totals.min()
    interval = []
    for side in (-1.0, 1.0):
        end = ends[side]
        if end is None:
            interval.append(side * np.inf)
            continue
        inside, outside = end

        def above(value: float, lowest: float = lowest) -> float:
            return track.data_squares(value) - lowest - threshold

        if above(inside) > 0:  # the lowest point is on the other side of the maximum
            inside = float(values[np.argmin(totals)])
        interval.append(optimize.brentq(above, inside, outside, xtol=1e-4 * sd, rtol=1e-10))
    finite = int(np.isfinite(interval).sum())
    shape: Shape = ("flat", "one-sided", "finite")[finite]
    return Profile(name, values, totals - lowest, float(interval[0]), float(interval[1]), shape, level)


class _Track:
    """Fits of all other parameters along one, each started from the last."""

    def __init__(self, problem: Problem, position: int, start: Floats) -> None:
        self.problem, self.position, self.unknowns = problem, position, start
        names = [n for i, n in enumerate(problem.model.free.names) if i != position]
        self.others = problem.model.cell.select(names)

    def restart(self, start: Floats) -> None:
        self.unknowns = start

    def data_squares(self, value: float) -> float:
        """Sum of squares of the data at a value of the parameter, the others re-optimised."""
        model = self.problem.model
        vector = model.held.copy()
        vector[model.free.slots[self.position]] = value
        part = Problem.of(
            CavityModel.of(model.cell, self.others, vector),
            self.problem.sweeps,
            self.problem.considered,
            self.problem.target,
        )
        if part.depends_on_point:
            part = part.relinearised(self.unknowns)
        solution = minimise(part, self.unknowns)
        self.unknowns = solution.unknowns
        residuals = part.data_residuals(solution.unknowns)
        return float(residuals @ residuals)


def _walk(
    track: _Track, points: dict[float, float], centre: float, step: float, reach: float, threshold: float
) -> tuple[float, float] | None:
    """Go outwards in growing steps until the threshold is passed; the last two points, or None within the reach."""
    inside = centre
    while True:
        outside = inside + step
        if abs(outside - centre) > reach:
            return None
        points[outside] = track.data_squares(outside)
        if points[outside] - min(points.values()) > threshold:
            return inside, outside
        inside, step = outside, 1.5 * step
