"""Is the posterior the same by a second method? Importance sampling around randomised optima.

Truths, sweeps and noise differ from case to case. Each reference draw solves the 21 equations Q'(F(u) - noise) = 0 by
Newton's method, F being the whitened residuals of data and prior and Q an orthonormal basis of the tangents at the
minimum, and is weighted by posterior over proposal density (Bardsley et al. 2014, SIAM J. Sci. Comput. 36). Draws
without a solution are left out: where the equations fold, the reference is short of what lies beyond.
"""

import os

# These are read when the libraries are imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import argparse
import time
from dataclasses import dataclass

import jax
import numpy as np
from jax_model import changes_in_jax
from rich.console import Console

from fpcal_bayes.infer import Identification, identify, sample
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps
from fpcal_bayes.report import plain_table
from fpcal_bayes.simulator import simulate_um
from fpcal_bayes.study import PROTOCOLS, drawn_truth, sbc_plan

#: Allowed differences: of means and quantiles in standard deviations, of standard deviations as a share.
MEAN, SD, QUANTILE = 0.06, 0.05, 0.12
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
#: Standard deviations of the noise in um that the cases take in turn.
NOISES = (0.002, 0.005, 0.01, 0.02)
_BATCH, _NEWTON_STEPS, _SHORTEST_STEP, _SOLVED = 500, 60, 1e-3, 1e-8


@dataclass(frozen=True)
class Reference:
    """Draws (n, n_unknowns) with weights that sum to one; `failed` equations had no solution."""

    draws: np.ndarray
    weights: np.ndarray
    failed: int

    @property
    def effective(self) -> float:
        return float(1.0 / (self.weights**2).sum())

    def quantile(self, share: float) -> np.ndarray:
        """Of each unknown."""
        order = np.argsort(self.draws, axis=0)
        below = np.cumsum(self.weights[order], axis=0) - 0.5 * self.weights[order]
        sorted_draws = np.take_along_axis(self.draws, order, axis=0)
        columns = zip(below.T, sorted_draws.T, strict=True)
        return np.array([np.interp(share, shares, values) for shares, values in columns])


def factor_of(sweeps: Sweeps) -> np.ndarray:
    """Inverse of the root of the measurements' covariance: rows of a group share the reading at their start."""
    sigma = np.asarray(sweeps.sigma)
    covariance = np.diag(sigma**2)
    group = np.asarray(sweeps.group)
    shared = (group[:, None] == group) & (group != "") & ~np.eye(len(sigma), dtype=bool)
    covariance[shared] = 0.5 * np.outer(sigma, sigma)[shared]
    return np.linalg.inv(np.linalg.cholesky(covariance))


class Residuals:
    """Whitened residuals F(u) of data and prior with their slopes, for many draws at once.

    Cavity lengths come from the program's kernel once it agrees with the model in JAX; the rest is written anew.
    """

    def __init__(self, found: Identification) -> None:
        problem = found.problem
        self.n = problem.n_unknowns
        self._model, self._mean, self._sd = problem.model, problem.prior.mean, problem.prior.sd
        self._rows = problem.model.rows(problem.sweeps.q_start, problem.sweeps.q_end)
        self._target, self._root = problem.sweeps.dl, factor_of(problem.sweeps)
        changes = changes_in_jax(found)
        for point in np.random.default_rng(0).standard_normal((3, self.n)):
            ours = self._model.predict_with_jacobian(self._mean + self._sd * point, self._rows)
            np.testing.assert_allclose(ours[0], changes(point), rtol=1e-10, atol=1e-8)
            np.testing.assert_allclose(ours[1] * self._sd, jax.jacfwd(changes)(point), rtol=1e-8, atol=1e-6)

    def __call__(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (n_draws, m + n) and slopes (n_draws, m + n, n)."""
        lengths, slopes = self._model.predict_with_jacobian(self._mean + self._sd * u, self._rows)
        data = self._root @ (slopes * self._sd)
        unit = np.broadcast_to(np.eye(self.n), (len(u), self.n, self.n))
        return np.hstack([(lengths - self._target) @ self._root.T, u]), np.concatenate([data, unit], axis=1)


def reference(found: Identification, draws: int, seed: int) -> Reference:
    """Draws from the posterior by importance sampling."""
    residuals = Residuals(found)
    # The minimum by Gauss-Newton, and the tangents there.
    best = found.solution.unknowns[None]
    for _ in range(5):
        now, slopes = residuals(best)
        best = best - np.linalg.lstsq(slopes[0], now[0])[0]
    basis = np.linalg.qr(residuals(best)[1][0])[0]
    noise = np.random.default_rng(seed).standard_normal((draws, len(basis)))
    parts = [_weighted(residuals, best, basis, part) for part in np.array_split(noise, -(-draws // _BATCH))]
    points, log_weights = (np.concatenate([part[i] for part in parts]) for i in range(2))
    weights = np.exp(log_weights - log_weights.max())
    return Reference(points, weights / weights.sum(), draws - len(points))


def _weighted(
    residuals: Residuals, start: np.ndarray, basis: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solutions of Q'(F(u) - noise) = 0 by Newton's method with halved steps, and their logarithmic weights."""
    wanted, points = noise @ basis, np.tile(start, (len(noise), 1))
    share = np.ones(len(noise))
    now, slopes = residuals(points)
    for _ in range(_NEWTON_STEPS):
        left = now @ basis - wanted
        size = np.linalg.norm(left, axis=1)
        active = np.flatnonzero((size >= _SOLVED) & (share > _SHORTEST_STEP))
        if not len(active):
            break
        step = np.linalg.solve(basis.T @ slopes[active], left[active][..., None])[..., 0]
        tries = points[active] - share[active, None] * step
        new, new_slopes = residuals(tries)
        nearer = np.linalg.norm(new @ basis - wanted[active], axis=1) < size[active]
        moved = active[nearer]
        points[moved], now[moved], slopes[moved] = tries[nearer], new[nearer], new_slopes[nearer]
        share[active] = np.where(nearer, np.minimum(1.0, 2.0 * share[active]), 0.5 * share[active])
    good = np.linalg.norm(now @ basis - wanted, axis=1) < _SOLVED
    now, slopes = now[good], slopes[good]
    log_determinant = np.linalg.slogdet(basis.T @ slopes)[1]
    outside = (now**2).sum(axis=1) - ((now @ basis) ** 2).sum(axis=1)
    return points[good], -0.5 * outside - log_determinant


def main() -> int:
    """Print the largest differences of each case; exit status 1 if one is too large."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=9)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--draws", type=int, default=10_000, help="effective draws of the posterior")
    parser.add_argument("--reference-draws", type=int, default=20_000)
    parser.add_argument("--opd", choices=("axis", "perpendicular"), default="axis")
    options = parser.parse_args()

    cell = load_cell(opd=options.opd, mechanics="none")
    columns = ["case", "sweeps", "noise nm", "effective", "failed", "max mean", "max sd %", "max quantile", "s"]
    table = plain_table("largest differences from the reference, in standard deviations of the reference", columns)
    good = True
    for number in range(options.first, options.first + options.cases):
        began = time.perf_counter()
        random = np.random.default_rng([7, number])
        protocol, sigma = PROTOCOLS[number % len(PROTOCOLS)], NOISES[number % len(NOISES)]
        sweeps = simulate_um(cell, drawn_truth(cell, random), sbc_plan(protocol, cell), sigma=sigma, seed=number)
        found = identify(cell, sweeps)
        posterior = sample(found, draws=options.draws, seed=number)
        ours = posterior.points.reshape(-1, found.problem.n_unknowns)
        theirs = reference(found, options.reference_draws, number)
        mean = theirs.weights @ theirs.draws
        sd = np.sqrt(theirs.weights @ (theirs.draws - mean) ** 2)
        off_mean = np.abs(ours.mean(axis=0) - mean) / sd
        off_sd = np.abs(ours.std(axis=0) / sd - 1.0)
        off_quantiles = np.array([np.abs(np.quantile(ours, p, axis=0) - theirs.quantile(p)) / sd for p in QUANTILES])
        fits = posterior.converged and off_mean.max() < MEAN and off_sd.max() < SD and off_quantiles.max() < QUANTILE
        good &= bool(fits)
        table.add_row(
            f"{number}{'' if fits else ' *'}",
            protocol,
            f"{1e3 * sigma:g}",
            f"{theirs.effective:.0f}",
            str(theirs.failed),
            f"{off_mean.max():.3f}",
            f"{100 * off_sd.max():.1f}",
            f"{off_quantiles.max():.3f}",
            f"{time.perf_counter() - began:.0f}",
        )
    Console(width=120, highlight=False).print(table)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
