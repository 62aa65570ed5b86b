"""Several charts, one for each minimum of the sum of squares, as one mixture of proposals."""

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fpcal_bayes.infer.posterior.chart import Chart, Solved
from fpcal_bayes.infer.posterior.target import Target

Floats = NDArray[np.float64]

#: Every chart gets at least this share of the proposals, so that none of its points is rare.
LEAST_SHARE = 0.1


class Atlas:
    """A mixture of charts.

    Parameters
    ----------
    target
        The density.
    references
        Reference points of the charts, shape (n_charts, n); the first is the lowest minimum.
    """

    def __init__(self, target: Target, references: Floats) -> None:
        self.target = target
        self.charts = [Chart(target, reference) for reference in references]
        residuals, _ = target.data_batch(np.atleast_2d(references))
        # Shares by the mass of each minimum in the Laplace approximation.
        mass = target.log_density(residuals, np.atleast_2d(references)) - [chart.log_volume for chart in self.charts]
        shares = np.maximum(special.softmax(mass), LEAST_SHARE)
        self.shares: Floats = shares / shares.sum()

    def propose(self, normal: Floats, choice: Floats) -> Solved:
        """Turn standard normal numbers (n_points, n) and uniform ones (n_points,) into points.

        The log density of the proposal is that of the whole mixture.
        """
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
            mixed: Floats = special.logsumexp(parts + np.log(self.shares)[:, None], axis=0)
        return mixed
