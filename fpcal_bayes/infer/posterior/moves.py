"""emcee moves: independent proposals from charts, and a local step shaped by the Jacobian where the walker stands."""

from collections.abc import Callable
from typing import Any

import numpy as np
from emcee.moves import Move
from emcee.state import State

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.proposal import ProposalMixture, Solved, in_parts
from fpcal_bayes.infer.posterior.target import PosteriorTarget


class RandomiseThenOptimiseMove(Move):  # type: ignore[misc]
    """Independent proposals from an atlas, `ahead` steps at once, exact everywhere: blobs hold their log density."""

    def __init__(self, atlas: ProposalMixture, ahead: int = 1) -> None:
        self.atlas, self.ahead = atlas, ahead
        self._ready: list[Solved] = []

    def forget(self) -> None:
        """Drop the proposals made ahead, which are no part of the random state."""
        self._ready.clear()

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        random = model.random
        if not self._ready:
            n_walkers, n = state.coords.shape
            total = self.ahead * n_walkers
            made = self.atlas.propose(random.standard_normal((total, n)), random.random_sample(total))
            self._ready = [made.take(slice(i, i + n_walkers)) for i in range(0, total, n_walkers)]
        solved = self._ready.pop()
        return independent_step(self, random, state, (solved.points, solved.log_density, solved.log_proposal))


def independent_step(
    move: Move, random: Any, state: State, proposed: tuple[Floats, Floats, Floats]
) -> tuple[State, Any]:
    """The step to independent proposals: points, their log densities, and log proposal densities (the blobs)."""
    points, log_density, log_proposal = proposed
    log_uniform = np.log(random.random_sample(len(points)))
    with np.errstate(invalid="ignore"):
        log_ratio = (log_density - log_proposal) - (state.log_prob - state.blobs)
    accepted = np.isfinite(log_proposal) & (log_uniform < log_ratio)
    return move.update(state, State(points, log_prob=log_density, blobs=log_proposal), accepted), accepted


def local_step(
    move: Move,
    state: State,
    points: Floats,
    log_density: Floats,
    accepted: Any,
    log_proposal: Callable[[Floats], Floats],
) -> tuple[State, Any]:
    """A local step, where proposal densities of the points that are reached are still to be worked out."""
    blobs = np.full(len(points), -np.inf)
    if accepted.any():
        blobs[accepted] = log_proposal(points[accepted])
    return move.update(state, State(points, log_prob=log_density, blobs=blobs), accepted), accepted


#: Step sizes, in posterior standard deviations; each step draws one. Curvature allows small ones only where the
#: posterior is long and bent, large ones reach across a fold.
SCALES = (0.03, 0.1, 0.3)


class LocalMove(Move):  # type: ignore[misc]
    """Metropolis-Hastings with v' = v + s R(v)^-1 z, R'R = J'J + I at v, which goes where no chart reaches."""

    def __init__(self, target: PosteriorTarget, atlas: ProposalMixture) -> None:
        self.target, self.atlas = target, atlas

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        random = model.random
        scale = SCALES[random.randint(len(SCALES))]
        factor, _ = self._metric(state.coords)
        normal = random.standard_normal(state.coords.shape)
        log_uniform = np.log(random.random_sample(len(normal)))
        points = state.coords + scale * np.linalg.solve(factor.transpose(0, 2, 1), normal[:, :, None])[:, :, 0]
        back, density = self._metric(points)
        returned = (back.transpose(0, 2, 1) @ (points - state.coords)[:, :, None])[:, :, 0] / scale
        forward = _log_determinant(factor) - 0.5 * (normal**2).sum(axis=1)
        backward = _log_determinant(back) - 0.5 * (returned**2).sum(axis=1)
        accepted = log_uniform < density - state.log_prob + backward - forward
        return local_step(self, state, points, density, accepted, self.atlas.log_proposal)

    def _metric(self, points: Floats) -> tuple[Floats, Floats]:
        """Lower Cholesky factors of J'J + I, shape (n_points, n, n), and log densities, of few points at a time."""
        factors, density = np.empty((*points.shape, points.shape[1])), np.empty(len(points))
        for part in in_parts(len(points), self.target.at_once):
            residuals, jacobian = self.target.data_batch(points[part])
            factors[part] = np.linalg.cholesky(jacobian.transpose(0, 2, 1) @ jacobian + np.eye(points.shape[1]))
            density[part] = self.target.log_density(residuals, points[part])
            del residuals, jacobian
        return factors, density


def _log_determinant(factor: Floats) -> Floats:
    return np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
