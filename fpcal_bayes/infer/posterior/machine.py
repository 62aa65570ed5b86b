"""The posterior of a machine: geometry and scales of the mechanics, exactly, by emcee.

A step of a walker (v, s) has two stages (delayed acceptance, Christen and Fox 2005). First a Metropolis step of
the scales alone on what the linearised rows say of them, p(s): from s to s'. Then a geometry v' by randomise-then-
optimise under the covariance of s', and one Metropolis step with the exact density:

    pi(v', s') p(s) q(v | s) / (pi(v, s) p(s') q(v' | s')).

The first stage leaves p invariant and is reversible, so the ratio is that of a proposal with the density
p(s') q(v'|s'), which each walker carries along (the blob). A local step in v reaches what no chart does.
"""

from collections import OrderedDict
from typing import Any

import numpy as np
from emcee.moves import Move
from emcee.state import State
from scipy import linalg, special

from fpcal_bayes.core.linalg import posterior_triangle
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import all_minima
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.mechanics.posterior import ScaleCharts
from fpcal_bayes.infer.mechanics.scales import ScaleProposal
from fpcal_bayes.infer.posterior.moves import SCALES, independent_step, local_step
from fpcal_bayes.infer.posterior.target import PosteriorTarget

#: Numbers in the factors that are kept with their charts.
_NUMBERS_KEPT = 2e7


class MachineTarget(PosteriorTarget):
    """Geometry in scores, then logarithms of the scales; rows are given all others, at the typical scales."""

    def __init__(self, fit: MechanicsFit) -> None:
        super().__init__(fit.problem)
        self.fit = fit

    @property
    def n_unknowns(self) -> int:
        return self.problem.n_unknowns + len(self.fit.scales.names)

    def noise_factors(self, points: Floats) -> Floats:
        return np.exp(points[..., -1])

    def log_likelihoods(self, points: Floats) -> Floats:
        return self.row_given_others(points)


class MachineCharts:
    """Charts of the geometry around each minimum, one per set of scales, kept for the walkers that stand on them."""

    def __init__(self, fit: MechanicsFit, seed: np.random.SeedSequence) -> None:
        self.fit, self.n, self.density = fit, fit.problem.n_unknowns, fit.whole_density
        mode = fit.scales.mode if self.density is fit.density else self.density.mode(fit.scales.mode)
        self.proposal = ScaleProposal.of(self.density, mode, np.random.default_rng(seed))
        minima = all_minima(fit.problem, fit.solution)
        self.references = [minimum.unknowns for minimum in minima]
        shares = np.maximum(special.softmax([-0.5 * minimum.sum_of_squares for minimum in minima]), 0.1)
        self.shares: Floats = shares / shares.sum()
        self.evaluations = 0
        self._most_kept = int(np.clip(_NUMBERS_KEPT / len(fit.problem.target) ** 2, 40, 256))
        self._kept: OrderedDict[bytes, tuple[float, list[ScaleCharts]]] = OrderedDict()
        triangle = posterior_triangle(fit.problem.data_jacobian(fit.solution.unknowns))
        self.metric: Floats = linalg.solve_triangular(triangle, np.eye(self.n))

    def prior(self, log_scales: Floats) -> Floats:
        """Log prior of scales (n_points, n_scales), shape (n_points,)."""
        return np.asarray(-0.5 * ((log_scales / self.density.prior_sd) ** 2).sum(axis=1))

    def charts(
        self, log_scales: Floats, made: dict[bytes, tuple[float, Floats]] | None = None
    ) -> tuple[Floats, list[ScaleCharts]]:
        """What linearised rows say of scales, and charts around each reference; `made` has some by the scales."""
        keys, made = [log.tobytes() for log in log_scales], {} if made is None else made
        missing = [i for i, key in enumerate(keys) if key not in self._kept and key not in made]
        made |= {keys[i]: each for i, each in zip(missing, self.density.at(log_scales[missing]), strict=True)}
        for key in keys:
            if key not in self._kept:
                value, lower = made[key]
                # A copy, without the others that were factorised beside it.
                factor, problem = [lower.copy(order="F")], self.fit.problem
                self._kept[key] = value, [ScaleCharts(problem, each, factor) for each in self.references]
            self._kept.move_to_end(key)
        found = [self._kept[key] for key in keys]
        while len(self._kept) > self._most_kept:
            self._kept.popitem(last=False)
        joined = [ScaleCharts.joined(parts) for parts in zip(*(charts for _, charts in found), strict=True)]
        return np.array([value for value, _ in found]), joined

    def move_scales(self, log_scales: Floats, random: Any) -> tuple[Floats, dict[bytes, tuple[float, Floats]]]:
        """A Metropolis step of scales (n_points, n_scales) on the linearised rows, and what `charts` takes."""
        level = self.charts(log_scales)[0] - self.proposal.log_density(log_scales)
        drawn, log_drawn = self.proposal.draw(len(log_scales), random)
        found = list(self.density.at(drawn))
        moved = np.log(random.random_sample(len(drawn))) < np.array([value for value, _ in found]) - log_drawn - level
        made = {drawn[i].tobytes(): found[i] for i in np.flatnonzero(moved)}
        return np.where(moved[:, None], drawn, log_scales), made

    def log_density(self, points: Floats) -> Floats:
        """The log posterior of geometry and scales at points (n_points, n_unknowns), unnormalised."""
        own, log_scales = points[:, : self.n], points[:, self.n :]
        self.evaluations += len(points)
        return self.charts(log_scales)[1][0].log_density(own) + self.prior(log_scales)

    def log_proposal(self, points: Floats) -> Floats:
        """Log density with which points (n_points, n_unknowns) are proposed; minus infinity outside every chart."""
        own, log_scales = points[:, : self.n], points[:, self.n :]
        linear, charts = self.charts(log_scales)
        return self._mixed(np.array([each.log_proposal(own) for each in charts])) + linear

    def propose(
        self, log_scales: Floats, random: Any, made: dict[bytes, tuple[float, Floats]] | None = None, widen: float = 1.0
    ) -> tuple[Floats, Floats, Floats]:
        """Geometries for sets of scales: points (n_points, n_unknowns), their log density and log proposal density."""
        count = len(log_scales)
        normal = widen * random.standard_normal((count, self.n))
        chosen = np.searchsorted(np.cumsum(self.shares)[:-1], random.random_sample(count), side="right")
        linear, charts = self.charts(log_scales, made)
        own = np.repeat(self.references[0][None], count, axis=0)
        log_density, parts = np.full(count, -np.inf), np.full((len(charts), count), -np.inf)
        for i, each in enumerate(charts):
            points, density, proposal = each.solve(normal, chosen == i)
            # The own chart's solution is on the right side of every fold.
            mine = (chosen == i) & np.isfinite(proposal)
            own[mine], log_density[mine], parts[i, mine] = points[mine], density[mine], proposal[mine]
        for i, each in enumerate(charts):
            if (chosen != i).any():
                parts[i] = np.where(chosen == i, parts[i], each.log_proposal(own))
        log_proposal = np.where(np.isfinite(log_density), self._mixed(parts) + linear, -np.inf)
        self.evaluations += 4 * count
        return np.hstack([own, log_scales]), log_density + self.prior(log_scales), log_proposal

    def _mixed(self, parts: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.asarray(special.logsumexp(parts + np.log(self.shares)[:, None], axis=0))


class MachineMove(Move):  # type: ignore[misc]
    """Scales by a step on their linearised posterior, then a geometry, then the exact step."""

    def __init__(self, charts: MachineCharts) -> None:
        self.charts = charts

    def forget(self) -> None:
        """Nothing is made ahead."""

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        random, charts = model.random, self.charts
        log_scales, made = charts.move_scales(state.coords[:, charts.n :], random)
        return independent_step(self, random, state, charts.propose(log_scales, random, made))


class MachineLocalMove(Move):  # type: ignore[misc]
    """A random walk of the geometry at the walker's own scales."""

    def __init__(self, charts: MachineCharts) -> None:
        self.charts = charts

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        random, charts = model.random, self.charts
        scale = SCALES[random.randint(len(SCALES))]
        step = random.standard_normal((len(state.coords), charts.n)) @ charts.metric.T
        points = state.coords.copy()
        points[:, : charts.n] += scale * step
        log_uniform = np.log(random.random_sample(len(points)))
        density = charts.log_density(points)
        return local_step(self, state, points, density, log_uniform < density - state.log_prob, charts.log_proposal)
