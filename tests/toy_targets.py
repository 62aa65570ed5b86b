"""Densities with known moments, written as residuals, and a way to run moves on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import emcee
import numpy as np

from fpcal_bayes.infer.posterior.proposal import ProposalMixture


class ToyTarget:
    """A target whose residuals and derivatives a subclass gives."""

    n_unknowns: int
    at_once = 1000

    def data_batch(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError

    def data_residuals(self, points: np.ndarray) -> np.ndarray:
        return self.data_batch(points)[0]

    def log_density(self, residuals: np.ndarray, points: np.ndarray) -> np.ndarray:
        return -0.5 * ((residuals**2).sum(axis=1) + (points**2).sum(axis=1))

    def centred(self, reference: np.ndarray) -> "ToyTarget":
        return self


class LinearTarget(ToyTarget):
    """N(0, Sigma) with standard deviations over two decades, in rotated axes."""

    def __init__(self, d: int, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.n_unknowns = d
        self.rotation = np.linalg.qr(random.standard_normal((d, d)))[0]
        self.scales = np.geomspace(0.1, 100.0, d)
        self.matrix = self.scales[:, None] * self.rotation.T

    def data_batch(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points @ self.matrix.T, np.broadcast_to(self.matrix, (len(points), *self.matrix.shape))

    @property
    def references(self) -> np.ndarray:
        return np.zeros((1, self.n_unknowns))

    def straight(self, points: np.ndarray) -> np.ndarray:
        """Coordinates in which the variances are known."""
        return points @ self.rotation

    @property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of the straight coordinates."""
        return np.zeros(self.n_unknowns), 1.0 / (1.0 + self.scales**2)

    def draw(self, n: int, random: np.random.Generator) -> np.ndarray:
        straight = np.sqrt(self.moments[1]) * random.standard_normal((n, self.n_unknowns))
        return straight @ self.rotation.T


@dataclass
class TwistedTarget(ToyTarget):
    """The line u2 = -bend (u1^2 - apart), `stiff` times thinner than the prior, in rotated axes; u3 and on are normal.

    Given u1 all is normal, so that what is left is one density in u1, known by quadrature. With a large `apart` it has
    two modes, at about -sqrt(apart) and sqrt(apart); `tilt` makes one of them heavier.
    """

    n_unknowns: int
    bend: float = 0.6
    apart: float = 1.0
    tilt: float = 0.0
    stiff: float = 5.0
    seed: int = 0

    @cached_property
    def rotation(self) -> np.ndarray:
        random = np.random.default_rng(self.seed)
        return np.linalg.qr(random.standard_normal((self.n_unknowns, self.n_unknowns)))[0]

    @cached_property
    def scales(self) -> np.ndarray:
        return np.geomspace(0.5, 50.0, max(self.n_unknowns - 2, 0))

    def straight(self, points: np.ndarray) -> np.ndarray:
        return points @ self.rotation

    def data_batch(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = self.straight(points)
        n = self.n_unknowns
        twisted = self.stiff * (u[:, 1] + self.bend * (u[:, 0] ** 2 - self.apart))
        residuals = np.column_stack([twisted, u[:, 0] - self.tilt, u[:, 2:] * self.scales])
        jacobian = np.zeros((len(points), n, n))
        jacobian[:, 0, 0], jacobian[:, 0, 1] = 2.0 * self.stiff * self.bend * u[:, 0], self.stiff
        jacobian[:, 1, 0] = 1.0
        jacobian[:, np.arange(2, n), np.arange(2, n)] = self.scales
        return residuals, jacobian @ self.rotation.T

    @cached_property
    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Values of u1 and their weights."""
        u = np.linspace(-8.0, 8.0, 200_001)
        share = self.stiff**2 / (1.0 + self.stiff**2)
        log = -0.5 * (u**2 + (u - self.tilt) ** 2 + share * self.bend**2 * (u**2 - self.apart) ** 2)
        weights = np.exp(log - log.max())
        return u, weights / weights.sum()

    @cached_property
    def references(self) -> np.ndarray:
        """The minima, lowest first."""
        u, weights = self.grid
        peaks = 1 + np.flatnonzero((weights[1:-1] > weights[:-2]) & (weights[1:-1] >= weights[2:]))
        # Far out, where all weights are rounding, there are no modes.
        peaks = peaks[weights[peaks] > 1e-6 * weights.max()]
        peaks = peaks[np.argsort(-weights[peaks])]
        found = np.zeros((len(peaks), self.n_unknowns))
        found[:, 0], found[:, 1] = u[peaks], self._mean_of_second(u[peaks])
        return found @ self.rotation.T

    def _mean_of_second(self, u: np.ndarray) -> np.ndarray:
        return -(self.stiff**2) / (1.0 + self.stiff**2) * self.bend * (u**2 - self.apart)

    @property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        u, weights = self.grid
        second = self._mean_of_second(u)
        mean, variance = np.zeros(self.n_unknowns), np.empty(self.n_unknowns)
        mean[0], mean[1] = weights @ u, weights @ second
        variance[0] = weights @ (u - mean[0]) ** 2
        variance[1] = weights @ (second - mean[1]) ** 2 + 1.0 / (1.0 + self.stiff**2)
        variance[2:] = 1.0 / (1.0 + self.scales**2)
        return mean, variance

    def draw(self, n: int, random: np.random.Generator) -> np.ndarray:
        values, weights = self.grid
        u = np.empty((n, self.n_unknowns))
        u[:, 0] = np.interp(random.random(n), np.cumsum(weights), values)
        u[:, 1] = self._mean_of_second(u[:, 0]) + random.standard_normal(n) / np.sqrt(1.0 + self.stiff**2)
        u[:, 2:] = random.standard_normal((n, self.n_unknowns - 2)) / np.sqrt(1.0 + self.scales**2)
        return u @ self.rotation.T


class CubicTarget(ToyTarget):
    """One unknown with the residual 2 (v^3 - v): h(v) rises, falls and rises, with folds known in closed form."""

    n_unknowns = 1

    def data_batch(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 2.0 * (points**3 - points), 2.0 * (3.0 * points**2 - 1.0)[:, :, None]


def run_moves(
    target: Any, atlas: ProposalMixture, moves: Sequence[Any], start: np.ndarray, n_steps: int, seed: int
) -> Any:
    """Draws (n_steps, n_walkers, n) of a mixture of emcee moves, in straight coordinates."""

    def log_probability(points: np.ndarray) -> np.ndarray:
        residuals = target.data_residuals(points)
        return np.column_stack([target.log_density(residuals, points), atlas.log_proposal(points)])

    sampler = emcee.EnsembleSampler(*start.shape, log_probability, moves=list(moves), vectorize=True)
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    sampler.run_mcmc(state, n_steps, skip_initial_state_check=True)
    chain = sampler.get_chain()
    return target.straight(chain.reshape(-1, target.n_unknowns)).reshape(chain.shape)
