"""emcee move: a local step shaped by the Jacobian where the walker stands."""

from typing import Any

import numpy as np
from emcee.moves import Move
from emcee.state import State
from numpy.typing import NDArray

from fpcal_bayes.infer.posterior.atlas import Atlas
from fpcal_bayes.infer.posterior.target import Target

Floats = NDArray[np.float64]

#: Step sizes, in posterior standard deviations; each step draws one. Curvature allows small ones only where the
#: posterior is long and bent, large ones reach across a fold.
SCALES = (0.03, 0.1, 0.3)


class LocalMove(Move):  # type: ignore[misc]
    """Metropolis-Hastings with v' = v + s R(v)^-1 z, R'R = J'J + I at v (a random walk on the posterior's own metric).

    It goes where no chart reaches, and so makes the mixture of moves irreducible.
    """

    def __init__(self, target: Target, atlas: Atlas) -> None:
        self.target, self.atlas = target, atlas

    def propose(self, model: Any, state: State) -> tuple[State, Any]:
        """Move every walker once."""
        random = model.random
        scale = SCALES[random.randint(len(SCALES))]
        _, jacobian = self.target.data_batch(state.coords)
        factor = _factors(jacobian)
        normal = random.standard_normal(state.coords.shape)
        log_uniform = np.log(random.random_sample(len(normal)))
        points = state.coords + scale * np.linalg.solve(factor.transpose(0, 2, 1), normal[:, :, None])[:, :, 0]
        residuals, jacobian = self.target.data_batch(points)
        density = self.target.log_density(residuals, points)
        back = _factors(jacobian)
        returned = (back.transpose(0, 2, 1) @ (points - state.coords)[:, :, None])[:, :, 0] / scale
        forward = _log_determinant(factor) - 0.5 * (normal**2).sum(axis=1)
        backward = _log_determinant(back) - 0.5 * (returned**2).sum(axis=1)
        accepted = log_uniform < density - state.log_prob + backward - forward
        blobs = np.full(len(points), -np.inf)
        if accepted.any():
            blobs[accepted] = self.atlas.log_proposal(points[accepted])
        return self.update(state, State(points, log_prob=density, blobs=blobs), accepted), accepted


def _factors(jacobian: Floats) -> Floats:
    """Lower Cholesky factors of J'J + I, shape (n_points, n, n)."""
    n = jacobian.shape[2]
    return np.linalg.cholesky(jacobian.transpose(0, 2, 1) @ jacobian + np.eye(n))


def _log_determinant(factor: Floats) -> Floats:
    """Log determinants of triangular matrices (n_points, n, n)."""
    result: Floats = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return result
