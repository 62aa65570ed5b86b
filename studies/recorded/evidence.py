"""What postures tell of an arm: parameters and deviations under priors whose sizes maximise the evidence.

The ball of all postures in one socket is one unknown point, up to errors of the ball and of each joint; the distance of
a plate's sockets is known. All is linear about the estimate, which gives the marginal likelihood of the sizes in closed
form. Postures far off weigh less, as Student errors with five degrees of freedom have it.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from arm import MECHANICS, Arm, Deviations, Floats, Postures
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

#: Distance of neighbouring sockets of a plate and its tolerance, in um.
PAIR, PAIR_SD = 50_000.0, 100.0
#: Errors as stated: of the ball in um, of a joint in rad.
BALL, JOINT = 300.0, 5e-4
#: Factors that are no group's of parameters or weights, in their order behind those.
ERRORS = ("distance", "ball", "joint")
_FACTOR_SD, _SOCKET_SD = 2.5, 1e6  # of the logarithm of each factor on a stated size; of a socket's place in um
_TAIL, _ROUNDS = 5.0, 3
STEMS = {"alpha": "angles", "theta": "angles", "d": "lengths", "r": "lengths", "gain": "gains"}


class Linear(NamedTuple):
    """Postures about one estimate: what is observed, and how it follows from parameters, weights and sockets."""

    miss: Floats  # ball less socket, shape (n, 3)
    slope: Floats  # of `miss`, shape (n, 3, n_unknowns)
    moves: Floats  # of the ball by the joints, shape (n, 3, n_joints)


class Fit:
    """An arm's parameters, the weights of its deviations and the factors on all sizes, from some postures.

    kinds: ``gains`` and those of `MECHANICS`.
    factors: logarithms of the factors; found by the evidence where they are not given.
    """

    def __init__(self, arm: Arm, postures: Postures, kinds: Sequence[str], factors: Floats | None = None) -> None:
        self.arm, self.postures, self.kinds = arm, postures, tuple(kinds)
        deviations = arm.deviations(postures.q, kinds)
        member = np.array([*(STEMS.get(p.name.partition("_")[0], "tool") for p in arm.free), *deviations.kind])
        held = (member == "gains") & ("gains" not in self.kinds)
        self.groups = tuple(name for name in dict.fromkeys(member[~held].tolist()) if name != "tool")
        stated = [p.prior_sd for p in arm.free] + [MECHANICS[kind] for kind in deviations.kind]
        self.x, self.sockets = np.zeros(len(member)), np.zeros((len(postures.places), 3))
        self._stated = np.concatenate([np.where(held, 1e-12, stated), np.full(self.sockets.size, _SOCKET_SD)])
        group = [self.groups.index(name) if name in self.groups else -1 for name in member]
        self._group = np.array([*group, *[-1] * self.sockets.size])
        self._weigh = np.ones(len(postures.q))
        self.factors = np.zeros(len(self.groups) + len(ERRORS)) if factors is None else factors
        for round_ in range(_ROUNDS):
            for _ in range(2 if round_ else 4):
                self._step(deviations)
            linear = self._linear(deviations)
            noise = np.linalg.inv(self._noise(self.factors, linear.moves))
            self._weigh = (_TAIL + 3) / (_TAIL + np.einsum("ni,nij,nj->n", linear.miss, noise, linear.miss))
            if factors is None:
                bounds = [(-7.0, 5.0)] * len(self.factors)
                given = (linear, np.append(self.x, 0.0 * self.sockets))
                self.factors = minimize(self.evidence, self.factors, given, "L-BFGS-B", jac=True, bounds=bounds).x
        self.log_evidence = -self.evidence(self.factors, linear, np.append(self.x, 0.0 * self.sockets))[0]
        for _ in range(2):
            self._step(deviations)

    def _linear(self, deviations: Deviations) -> Linear:
        point, slope, moves = look(self.arm, self.postures.q, deviations, self.x)
        n, socket = len(point), self.postures.socket
        self.sockets = self.postures.means(point)
        place = np.zeros((n, 3, len(self.sockets), 3))
        place[np.arange(n), :, socket, :] = -np.eye(3)
        return Linear(point - self.sockets[socket], np.concatenate([slope, place.reshape(n, 3, -1)], axis=2), moves)

    def _noise(self, factors: Floats, moves: Floats) -> Floats:
        ball, joint = np.exp(2.0 * factors[-2:]) * (BALL**2, JOINT**2)
        return ball * np.eye(3) + joint * moves @ np.swapaxes(moves, 1, 2)

    def _pairs(self) -> tuple[Floats, Floats]:
        """Distances of neighbouring sockets less the known one, and their slopes."""
        rows, off = [], []
        for (i, one), (j, other) in pairwise(enumerate(self.postures.places)):
            if one[0] == other[0]:
                way = self.sockets[j] - self.sockets[i]
                row = np.zeros((len(self.sockets), 3))
                row[j], row[i] = way / np.linalg.norm(way), -way / np.linalg.norm(way)
                rows.append(np.concatenate([np.zeros(len(self.x)), row.ravel()]))
                off.append(np.linalg.norm(way) - PAIR)
        return np.array(off), np.array(rows).reshape(len(off), len(self._stated))

    def _posterior(self, factors: Floats, linear: Linear, start: Floats) -> tuple[Floats, Floats, float, Floats]:
        """Mean, covariance, minus the log evidence up to a constant, and inverse noise per posture."""
        size = self._stated * np.exp(np.append(factors[: -len(ERRORS)], 0.0))[self._group]
        noise = self._noise(factors, linear.moves) / self._weigh[:, None, None]
        root = np.linalg.inv(np.linalg.cholesky(noise))
        (off, rows), pair_sd = self._pairs(), PAIR_SD * np.exp(factors[-3])
        design = np.concatenate([(root @ linear.slope).reshape(-1, len(size)), rows / pair_sd])
        aim = -np.concatenate([np.einsum("nij,nj->ni", root, linear.miss).ravel(), off / pair_sd]) + design @ start
        scaled = design * size
        factor = cho_factor(np.eye(len(size)) + scaled.T @ scaled, lower=True)
        z = cho_solve(factor, scaled.T @ aim)
        minus = 0.5 * aim @ (aim - scaled @ z) + np.log(np.diag(factor[0])).sum() + len(off) * factors[-3]
        minus -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum()
        covariance = size[:, None] * cho_solve(factor, np.eye(len(size))) * size
        return size * z, covariance, float(minus), np.swapaxes(root, 1, 2) @ root

    def evidence(self, factors: Floats, linear: Linear, start: Floats) -> tuple[float, Floats]:
        """Minus the logarithm of the factors' density given the postures, up to a constant, and its gradient."""
        mean, covariance, minus, inverse = self._posterior(factors, linear, start)
        size = self._stated * np.exp(np.append(factors[: -len(ERRORS)], 0.0))[self._group]
        share = 1.0 - (mean**2 + np.diag(covariance)) / size**2
        gradient = [share[self._group == i].sum() for i in range(len(self.groups))]
        (off, rows), pair_var = self._pairs(), PAIR_SD**2 * np.exp(2.0 * factors[-3])
        far = (off + rows @ (mean - start)) ** 2 + np.einsum("ij,jk,ik->i", rows, covariance, rows)
        gradient.append(float(np.sum(1.0 - far / pair_var)))
        left = linear.miss + np.einsum("nij,j->ni", linear.slope, mean - start)
        second = np.einsum("ni,nj->nij", left, left)
        second += np.einsum("nij,jk,nlk->nil", linear.slope, covariance, linear.slope, optimize=True)
        turn = (inverse - inverse @ second @ inverse) / self._weigh[:, None, None]
        parts = [self._noise(factors[-2:] + kept, linear.moves) for kept in ([0.0, -np.inf], [-np.inf, 0.0])]
        gradient += [float(np.einsum("nij,nji->", turn, part)) for part in parts]
        spread = factors / _FACTOR_SD**2
        return minus + 0.5 * float(factors @ spread), np.array(gradient) + spread

    def _step(self, deviations: Deviations) -> None:
        linear = self._linear(deviations)
        mean, covariance, *_ = self._posterior(self.factors, linear, np.append(self.x, 0.0 * self.sockets))
        self.x, self.covariance = mean[: len(self.x)], covariance[: len(self.x), : len(self.x)]

    def predict(self, postures: Postures) -> tuple[Floats, Floats, Floats]:
        """Where the ball of other postures stands: points (n, 3) in um, slopes (n, 3, n_unknowns), noise (n, 3, 3)."""
        point, slope, moves = look(self.arm, postures.q, self.arm.deviations(postures.q, self.kinds), self.x)
        return point, slope, self._noise(self.factors, moves)


def look(arm: Arm, q: Floats, deviations: Deviations, x: Floats) -> tuple[Floats, Floats, Floats]:
    """The ball's points, their slopes by parameters and weights `x`, and by the joints."""
    n = len(arm.free)
    turned = q.copy()
    np.add.at(turned, (slice(None), deviations.joint), deviations.values * x[n:])
    point, slope, moves = arm.points(arm.free.nominal + x[:n], turned)
    weights = moves[:, :, deviations.joint] * deviations.values[:, None, :]
    return point, np.concatenate([slope, weights], axis=2), moves
