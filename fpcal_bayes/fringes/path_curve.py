"""Fit the error along a path to the irradiance: a smooth curve, with the levels of the fringes as nuisances.

The reference scans around the path tell mean and height of the fringes, which may drift and bow between them. Near an
extreme of a fringe the irradiance does not tell whether the cavity length goes on or turns, so several curves are
fitted and compared: those that a Kalman filter follows, and each of them turned at the extremes that it meets. The
smoothest of curves that fit as well is the likeliest: the size of the second differences is taken as unknown, with its
scale-free prior.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import least_squares

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.kernels import follow_phase
from fpcal_bayes.fringes.reference import FringeFit

#: How mean and amplitude may bow between two reference scans that agree, relative, one standard deviation, unless told:
#: laser power and detector are stable to half a percent in ten seconds. Where the scans differ, as much is added.
STABILITY = 5e-3
#: Their relative drift where there is no second scan.
_UNKNOWN_DRIFT = 1e-2
#: Spline pieces along a path.
_PIECES = 24
#: Standard deviation of the spline's second differences, in um: at first, and at the least.
_ROUGH, _SMOOTH = 0.1, 1e-3
#: The path starts where the reference scan stood, up to the error of the small step to half height, in um.
_START = 2e-4
#: What the error may do along a path, for the filter: speed at the start in rad a path, acceleration in rad a path^2.
_SPEED, _ACCELERATION = 30.0, 160.0
_STEPS = 40
#: A second curve counts if it leaves the first by a share of a fringe and its objective is higher by less than this.
_APART, _RIVAL = 0.03, 12.0
#: At most so many extremes are tried as turning points; an extreme is where the sine of the phase is below this.
_TURNS, _EXTREME = 4, 0.3


@dataclass(frozen=True, eq=False)
class Levels:
    """Mean and height of the fringes, between a reference scan before a path and, where there is one, one after it."""

    first: FringeFit  # the reference scan before the path
    last: FringeFit | None  # the one after it
    share: Floats  # how far the samples of the path stand between the scans in time, shape (n,)
    lift: Floats  # by how much the mean rises for a volt of amplitude, since the mirror moves and tilts, shape (n,)
    ratio: Floats  # amplitude relative to that of the first scan's place, shape (n,)
    stability: float = STABILITY  # how mean and amplitude may bow between the scans, relative, one standard deviation

    def prior(self) -> tuple[Floats, Floats]:
        """Mean, amplitude at both ends, phase, bows of both: expected (7,) and covariance (7, 7), in V and rad."""
        first, last = self.first, self.last
        c, s = np.cos(first.phase), np.sin(first.phase)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s / first.amplitude, c / first.amplitude]])
        begin = turn @ first.covariance @ turn.T
        expected = np.array([first.mean, first.amplitude, first.mean, first.amplitude, first.phase, 0.0, 0.0])
        covariance = np.zeros((7, 7))
        at = [0, 1, 4]
        covariance[np.ix_(at, at)] = begin
        if last is None:
            drift = _UNKNOWN_DRIFT * np.array([first.mean, first.amplitude])
            covariance[[2, 3], [2, 3]] = begin[[0, 1], [0, 1]] + drift**2
        else:
            expected[2], expected[3] = last.mean, last.amplitude / self.ratio[-1]
            covariance[[2, 3], [2, 3]] = last.covariance[0, 0], last.covariance[1, 1] / self.ratio[-1] ** 2
        covariance[[5, 6], [5, 6]] = (expected[2:4] - expected[:2]) ** 2 / 2.0 + (self.stability * expected[:2]) ** 2
        return expected, covariance

    def weights(self) -> tuple[Floats, Floats]:
        """How mean and amplitude follow from the nuisances but the phase: two matrices, each of shape (n, 7)."""
        bow, none = 4.0 * self.share * (1.0 - self.share), np.zeros_like(self.share)
        mean = np.column_stack([1.0 - self.share, none, self.share, none, none, bow, none])
        amplitude = np.column_stack([none, 1.0 - self.share, none, self.share, none, none, bow])
        return mean + self.lift[:, None] * amplitude, self.ratio[:, None] * amplitude


@dataclass(frozen=True, eq=False)
class Curve:
    """A fitted error along a path."""

    error: Floats  # in um, shape (n,)
    coefficients: Floats  # of spline and nuisances, shape (n_splines + 7,)
    covariance: Floats  # of these, shape (n_splines + 7, n_splines + 7)
    basis: Floats  # splines at the samples, shape (n, n_splines)
    residual: float  # standard deviation of the irradiance around the curve, in V
    objective: float  # sum of squares over data, roughness and prior of the levels
    rival: Floats | None = None  # error of another curve that fits nearly as well and leaves it somewhere

    def draws(self, random: np.random.Generator, n: int, places: NDArray[np.int64]) -> Floats:
        """Errors of the curve itself at some samples, as draws, shape (n, n_places), in um."""
        count = self.basis.shape[1]
        scatter = self.covariance[:count, :count]
        root = np.linalg.cholesky(scatter + 1e-12 * np.diag(np.diag(scatter)))
        return np.asarray(random.standard_normal((n, count)) @ root.T @ self.basis[places].T)


def fit_curve(irradiance: Floats, expected: Floats, levels: Levels) -> Curve:
    """The best fit of several starts: irradiance (n,) in V, `expected` phase in rad beyond the first scan's."""
    fit = _Fit.of(irradiance, expected, levels)
    curves = [fit.minimise(start) for start in fit.starts()]
    best = min(curves, key=lambda curve: curve.objective)
    curves += [fit.minimise(start) for start in fit.turned(best)]
    curves.sort(key=lambda curve: curve.objective)
    best, wave_number = curves[0], levels.first.wave_number
    for other in curves[1:]:
        apart = np.abs(other.error - best.error).max() > _APART * 2.0 * np.pi / wave_number
        if apart and other.objective < best.objective + _RIVAL:
            return replace(best, rival=other.error)
    return best


def splines(at: Floats) -> Floats:
    """Cubic B-splines at places from 0 to 1, shape (n, n_splines)."""
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, _PIECES + 1), np.ones(3)])
    return np.asarray(BSpline.design_matrix(at, knots, 3).toarray())


@dataclass(frozen=True, eq=False)
class _Fit:
    """The data of one fit; unknowns are the spline's coefficients in um, then the nuisances of `Levels`."""

    irradiance: Floats
    expected: Floats
    first: FringeFit
    basis: Floats
    noise: float
    prior: Floats
    whitened: Floats
    by_mean: Floats
    by_amplitude: Floats

    @classmethod
    def of(cls, irradiance: Floats, expected: Floats, levels: Levels) -> "_Fit":
        first, (prior, covariance) = levels.first, levels.prior()
        return cls(
            irradiance,
            expected,
            first,
            splines(np.linspace(0.0, 1.0, len(irradiance))),
            max(first.noise, 1e-3 * first.amplitude),
            prior,
            np.linalg.inv(np.linalg.cholesky(covariance)),
            *levels.weights(),
        )

    def starts(self) -> Iterator[Floats]:
        """Curves to begin with, in um: none, and those that the filter follows."""
        n, mean, amplitude = len(self.irradiance), self.by_mean @ self.prior, self.by_amplitude @ self.prior
        yield np.zeros(n)
        jerk = _ACCELERATION**2 * 0.2 / n**3
        for spread in (0.0, 0.1):
            sd = np.hypot(self.noise / amplitude, spread)
            height = (self.irradiance - mean) / amplitude
            excess = follow_phase(height, sd, self.expected + self.prior[4], 0.05, _SPEED / n, jerk)
            yield excess / self.first.wave_number

    def turned(self, curve: Curve) -> Iterator[Floats]:
        """The curve turned at each of the extremes of the fringe that it meets, from there on."""
        phase = self.phase(curve.coefficients)
        sine = np.abs(np.sin(phase))
        # The ends have no neighbour, so that a curve that only just reaches an extreme counts too.
        padded = np.concatenate([[np.inf], sine, [np.inf]])
        for place in np.flatnonzero((sine < _EXTREME) & (sine <= padded[:-2]) & (sine < padded[2:]))[:_TURNS]:
            other = 2.0 * np.round(phase[place] / np.pi) * np.pi - phase
            yield curve.error + np.where(np.arange(len(phase)) >= place, other - phase, 0.0) / self.first.wave_number

    def phase(self, unknowns: Floats) -> Floats:
        """Phase of the fringes at each sample."""
        count = self.basis.shape[1]
        phase = self.expected + unknowns[count + 4] + self.first.wave_number * (self.basis @ unknowns[:count])
        return np.asarray(phase)

    def minimise(self, start: Floats) -> Curve:
        """The minimum near a curve `start` (n,), in um: first with room for bends, then with as much as it takes."""
        count = self.basis.shape[1]
        bend = np.diff(np.eye(count), n=2, axis=0)
        shape = np.linalg.solve(self.basis.T @ self.basis + 1e-6 * bend.T @ bend, self.basis.T @ start)
        unknowns, rough = np.append(shape, self.prior), _ROUGH
        for _ in range(3):
            unknowns, left, hessian = self._descend(unknowns, rough)
            size = float(np.sqrt(((bend @ unknowns[:count]) ** 2).mean()))
            rough = float(np.clip(2.0 * size, _SMOOTH, _ROUGH))
        levels = self.whitened @ (unknowns[count:] - self.prior)
        objective = float(left @ left + levels @ levels) + len(bend) * np.log(size**2 + _SMOOTH**2)
        residual = self.noise * float(np.sqrt((left**2).mean()))
        covariance = max(1.0, residual / self.noise) ** 2 * np.linalg.inv(hessian)
        return Curve(self.basis @ unknowns[:count], unknowns, covariance, self.basis, residual, objective)

    def _descend(self, unknowns: Floats, rough: float) -> tuple[Floats, Floats, Floats]:
        """Levenberg-Marquardt: unknowns, whitened residuals, Hessian of half the sum of squares."""
        count, size = self.basis.shape[1], len(unknowns)
        rows = np.zeros((count - 1 + len(self.prior), size))
        rows[: count - 2, :count] = np.diff(np.eye(count), n=2, axis=0) / rough
        rows[count - 2, 0] = 1.0 / _START
        rows[count - 1 :, count:] = self.whitened
        target = rows @ np.append(np.zeros(count), self.prior)

        def residuals(at: Floats) -> Floats:
            height = self.by_mean @ at[count:] + (self.by_amplitude @ at[count:]) * np.cos(self.phase(at))
            return np.append((height - self.irradiance) / self.noise, rows @ at - target)

        def jacobian(at: Floats) -> Floats:
            phase = self.phase(at)
            slope = -(self.by_amplitude @ at[count:]) * np.sin(phase)
            levels = self.by_mean + self.by_amplitude * np.cos(phase)[:, None]
            levels[:, 4] = slope
            data = np.hstack([(slope * self.first.wave_number)[:, None] * self.basis, levels]) / self.noise
            return np.vstack([data, rows])

        found = least_squares(residuals, unknowns, jacobian, method="lm", max_nfev=_STEPS)
        slopes = jacobian(found.x)
        return found.x, found.fun[: len(self.irradiance)], slopes.T @ slopes
