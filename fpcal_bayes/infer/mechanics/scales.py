"""How large the mechanics really are: the posterior of the scales, with everything else marginalised.

Rows r = J v + B w + e, linear at the fitted geometry: v standard normal scores of the geometry's prior, w weights whose
variance is the square of their scale, e noise. For scales s the rows have the covariance

    K(s) = J J' + sum_k s_k^2 B_k B_k' + s_return^2 Sigma_return + s_noise^2 Sigma_noise.

Each log s has a normal prior around the data sheet. Their joint posterior is sampled by importance: a Student-t around
the mode, adapted once. It is sampled, not maximised: data that cannot see an error motion leave its scale where the
sheet puts it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats, Ints

#: One standard deviation of a scale's logarithm: a factor 3, of the noise 1.5.
LOG_SD, LOG_SD_NOISE = float(np.log(3.0)), float(np.log(1.5))
_DOF = 7.0
_POOL, _N_DRAWS = (200, 400), 100
_SWELL = 1.15
#: Numbers in the covariances that are made together.
_AT_ONCE = 1_000_000
_MODE_STEPS, _LONGEST, _MODE_GAIN = 20, 1.0, 1e-2


@dataclass(frozen=True, repr=False)
class LinearRows(Brief):
    """The linearised problem of the scales."""

    target: Floats  # r, measured minus predicted at v = 0 on the tangent, shape (n,), in um
    geometry: Floats  # J, shape (n, n_free)
    weights: Floats  # B at stated sizes, shape (n, n_weights)
    scale: Ints  # which scale each weight has, shape (n_weights,)
    # noise, returns: covariances at stated sizes, shape (n, n)
    noise: Floats
    returns: Floats
    # rest, rest_dof: of rows that were compressed: sum of squares and number of what only noise explains
    rest: float = 0.0
    rest_dof: int = 0


@dataclass(frozen=True)
class ScalePosterior:
    """Draws of the scales, as factors on the stated sizes."""

    names: tuple[str, ...]  # of the scales, n of them
    log: Floats  # logarithms of equally likely draws, shape (n_draws, n)
    mode: Floats  # where the posterior is highest, shape (n,)

    def quantiles(self) -> Floats:
        """Lower edge of the 95 % band, median and upper edge of each factor, shape (3, n)."""
        return np.exp(np.quantile(self.log, [(1.0 - 0.95) / 2.0, 0.5, (1.0 + 0.95) / 2.0], axis=0))


class ScaleDensity:
    """Unnormalised log posterior of the logarithms of the scales.

    rows: the linearised problem.
    names: of the scales; the last two are return and noise.
    """

    def __init__(self, rows: LinearRows, names: tuple[str, ...]) -> None:
        self.rows, self.names = rows, names
        n, n_scales = len(rows.target), len(names)
        self.prior_sd = np.full(n_scales, LOG_SD)
        self.prior_sd[-1] = LOG_SD_NOISE
        self._parts = np.empty((n_scales, n, n))
        self.columns = [np.flatnonzero(rows.scale == k) for k in range(n_scales)]
        for k, columns in enumerate(self.columns):
            part = rows.weights[:, columns]
            self._parts[k] = part @ part.T
        self._parts[-2] += rows.returns
        self._parts[-1] += rows.noise
        self._fixed = rows.geometry @ rows.geometry.T
        self._linear = np.asfortranarray(np.column_stack([rows.geometry, rows.target]))
        # A scale that no row feels stays out of the search; its draws come from the prior.
        self.felt = np.array([part.any() for part in self._parts])

    def covariance(self, log: Floats) -> Floats:
        """K(s), shape (n, n)."""
        n = len(self.rows.target)
        return np.asarray((np.exp(2.0 * log) @ self._parts.reshape(len(log), -1)).reshape(n, n) + self._fixed)

    def factor(self, log: Floats) -> Floats:
        """Lower Cholesky factor of K(s)."""
        lower, failed = linalg.lapack.dpotrf(self.covariance(log), lower=1, overwrite_a=1, clean=1)
        if failed:
            raise linalg.LinAlgError("the covariance of the rows is not positive definite")
        return np.asarray(lower)

    def at(self, log_scales: Floats) -> Iterator[tuple[float, Floats]]:
        """The log posterior at points (n_points, n_scales), each with the lower Cholesky factor of C(s) = K(s) - J J'.

        What stands above a factor's diagonal is not to be read; a value of minus infinity comes with no factor.
        """
        n, n_geometry = self.rows.geometry.shape
        step = max(1, _AT_ONCE // n**2)
        for first in range(0, len(log_scales), step):
            part = log_scales[first : first + step]
            totals = (np.exp(2.0 * part) @ self._parts.reshape(len(self.names), -1)).reshape(-1, n, n)
            for log, total in zip(part, totals, strict=True):
                # Its transpose is itself, in the order that LAPACK takes.
                lower, failed = linalg.lapack.dpotrf(total.T, lower=1, overwrite_a=1, clean=0)
                if failed:
                    yield -np.inf, lower
                    continue
                white = linalg.lapack.dtrtrs(lower, self._linear, lower=1)[0]
                gram = white.T @ white
                target = gram[-1, -1]
                gram[np.arange(n_geometry), np.arange(n_geometry)] += 1.0
                # Woodbury: K from C with the geometry's own few directions.
                root = linalg.lapack.dpotrf(gram[:-1, :-1], lower=1, clean=0)[0]
                seen = linalg.lapack.dtrtrs(root, gram[:-1, -1], lower=1)[0]
                volume = np.log(lower.diagonal()).sum() + np.log(root.diagonal()).sum()
                total_value = -0.5 * (target - seen @ seen) - volume - 0.5 * ((log / self.prior_sd) ** 2).sum()
                yield float(total_value + self._rest(log[-1])), lower

    def value(self, log: Floats) -> float:
        """The log posterior."""
        return next(self.at(log[None]))[0]

    def value_and_slope(self, log: Floats) -> tuple[float, Floats]:
        """The log posterior and its derivatives."""
        lower = self.factor(log)
        inverse = linalg.lapack.dpotri(lower, lower=1)[0]
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        solved = inverse @ self.rows.target
        total = -0.5 * self.rows.target @ solved - np.log(np.diag(lower)).sum()
        pull = np.outer(solved, solved) - inverse
        slope = np.exp(2.0 * log) * (self._parts.reshape(len(log), -1) @ pull.ravel())
        slope[-1] += self.rows.rest * np.exp(-2.0 * log[-1]) - self.rows.rest_dof
        total += self._rest(log[-1]) - 0.5 * ((log / self.prior_sd) ** 2).sum()
        return float(total), slope - log / self.prior_sd**2

    def curvature(self, log: Floats) -> Floats:
        """Expected curvature (Fisher) of minus the log posterior, shape (n_scales, n_scales)."""
        lower = self.factor(log)
        white = []
        for columns in self.columns[:-2]:
            part = self.rows.weights[:, columns]
            white.append(linalg.solve_triangular(lower, part, lower=True, check_finite=False))
        for part in self._parts[-2:]:
            half = linalg.solve_triangular(lower, part, lower=True, check_finite=False)
            white.append(linalg.solve_triangular(lower, half.T, lower=True, check_finite=False))
        n_scales = len(log)
        fisher = np.empty((n_scales, n_scales))
        for a in range(n_scales):
            for b in range(a + 1):
                # tr(K^-1 G_a K^-1 G_b), the last two being covariances themselves.
                if a >= n_scales - 2 and b >= n_scales - 2:
                    shared = (white[a] * white[b]).sum()
                elif a >= n_scales - 2:
                    shared = (white[b] * (white[a] @ white[b])).sum()
                else:
                    shared = ((white[a].T @ white[b]) ** 2).sum()
                fisher[a, b] = fisher[b, a] = shared
        size = np.exp(2.0 * log)
        fisher *= 2.0 * np.outer(size, size)
        fisher[-1, -1] += 2.0 * self.rows.rest * np.exp(-2.0 * log[-1])
        fisher[np.diag_indices(n_scales)] += 1.0 / self.prior_sd**2
        return fisher

    def mode(self, start: Floats | None = None) -> Floats:
        """Where the log posterior is highest, shape (n_scales,): Fisher's scoring with steps that go up."""
        log = np.zeros(len(self.names)) if start is None else start
        best = self.value(log)
        for _ in range(_MODE_STEPS):
            _, slope = self.value_and_slope(log)
            step = np.linalg.solve(self.curvature(log), slope)
            gain = float(slope @ step)
            step *= min(1.0, _LONGEST / float(np.abs(step).max()))
            for _ in range(6):
                value = self.value(log + step)
                if value > best:
                    break
                step = step / 2.0
            else:
                break
            log, best = log + step, value
            if gain < _MODE_GAIN:
                break
        return log

    def _rest(self, log_noise: float) -> float:
        return float(-0.5 * self.rows.rest * np.exp(-2.0 * log_noise) - self.rows.rest_dof * log_noise)


def sample_scales(density: ScaleDensity, mode: Floats, rng: np.random.Generator) -> ScalePosterior:
    """Draw scales from their posterior by importance sampling, adapted once."""
    pool = _Pool(density, mode, rng)
    # Systematic resampling: equally likely draws.
    places = (np.arange(_N_DRAWS) + rng.random()) / _N_DRAWS
    chosen = np.minimum(np.searchsorted(np.cumsum(pool.weights), places), len(pool.log) - 1)
    return ScalePosterior(density.names, pool.log[chosen], mode)


@dataclass(frozen=True)
class ScaleProposal:
    """A Student-t around the scales' mode, adapted to their posterior: draws with their density."""

    centre: Floats
    factor: Floats

    @classmethod
    def of(cls, density: ScaleDensity, mode: Floats, rng: np.random.Generator) -> "ScaleProposal":
        """Adapted on a few hundred draws."""
        return cls(*_Pool(density, mode, rng).adapted)

    def draw(self, count: int, rng: np.random.RandomState) -> tuple[Floats, Floats]:
        """Draws (count, n_scales) and their log densities (count,)."""
        drawn = _draw_t(self.centre, self.factor, count, rng)
        return drawn, self.log_density(drawn)

    def log_density(self, points: Floats) -> Floats:
        """Log density of points (n_points, n_scales), unnormalised."""
        return _log_t(points, self.centre, self.factor)


class _Pool:
    """Draws from Student-t proposals around the mode, adapted once, with their densities."""

    def __init__(self, density: ScaleDensity, mode: Floats, rng: np.random.Generator) -> None:
        centre, covariance = mode, np.linalg.inv(density.curvature(mode))
        proposals: list[tuple[Floats, Floats]] = []
        self.log, self.values = np.empty((0, len(mode))), np.empty(0)
        for count in _POOL:
            proposals.append((centre, np.linalg.cholesky(_SWELL**2 * covariance)))
            drawn = _draw_t(*proposals[-1], count, rng)
            self.log = np.concatenate([self.log, drawn])
            self.values = np.concatenate([self.values, [value for value, _ in density.at(drawn)]])
            shares = np.array(_POOL[: len(proposals)], dtype=float)
            each = np.array([_log_t(self.log, *proposal) for proposal in proposals])
            self.log_mixture = np.logaddexp.reduce(each + np.log(shares / shares.sum())[:, None], axis=0)
            # Tempered for the adaptation, so that few heavy draws do not make it narrow.
            soft = self.weights**0.5 / (self.weights**0.5).sum()
            centre = soft @ self.log
            covariance = (self.log - centre).T @ ((self.log - centre) * soft[:, None])
        self.adapted = centre, np.linalg.cholesky(_SWELL**2 * covariance)

    @property
    def weights(self) -> Floats:
        """Normalised importance weights."""
        ratio = self.values - self.log_mixture
        weights = np.exp(ratio - ratio.max())
        return np.asarray(weights / weights.sum())


def _draw_t(centre: Floats, factor: Floats, count: int, rng: np.random.Generator | np.random.RandomState) -> Floats:
    normal = rng.standard_normal((count, len(centre))) @ factor.T
    return np.asarray(centre + normal / np.sqrt(rng.chisquare(_DOF, count) / _DOF)[:, None])


def _log_t(points: Floats, centre: Floats, factor: Floats) -> Floats:
    white = linalg.solve_triangular(factor, (points - centre).T, lower=True, check_finite=False)
    distance = (white**2).sum(axis=0)
    return np.asarray(-0.5 * (_DOF + len(centre)) * np.log1p(distance / _DOF) - np.log(np.diag(factor)).sum())
