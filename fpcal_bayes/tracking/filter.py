"""The Kalman filter: predict over time, update with rows, iterated where they are not linear.

The update is the maximum of the posterior of state and rows (Gauss-Newton, Bell & Cathey 1993), each step shortened
until it goes down; filterpy takes the last step, with the Joseph form of the covariance.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan

import numpy as np
from filterpy.kalman import KalmanFilter
from filterpy.kalman import update as kalman_update
from scipy.linalg import lapack

from fpcal_bayes.core.linalg import covariance_root, identity, symmetric
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.measurement import LinearMeasurement, Measurement, equivalent_rows

#: The iteration ends when a step is shorter than this, in standard deviations of the prediction.
_STEP_TOLERANCE = 1e-3
_MAX_STEPS = 50
_SLOW = 0.3
#: Gauss-Newton steps before Newton steps take over: where the rows bend more than they tell, the former creep.
_PATIENCE = 10
#: Where no step lowers the sum of squares beyond its rounding, a state this near to rest has come to rest.
_AT_REST = 0.05
_LOG_2_PI = float(np.log(2.0 * np.pi))
#: What rounding may add to the sum of squares.
_ROUNDING = 1e-9


@dataclass(frozen=True, repr=False)
class Innovation(Brief):
    """What rows say beyond the prediction, linearised at it; of many rows the `equivalent_rows`."""

    misfit: Floats  # whitened measurement minus prediction, shape (n_equivalent,)
    jacobian: Floats  # its derivatives by the state, shape (n_equivalent, n_states)
    factor: Floats  # lower Cholesky factor of the misfit's covariance, shape (n_equivalent, n_equivalent)
    log_volume: float
    dof: int  # number of rows that were measured

    @classmethod
    def of(cls, misfit: Floats, jacobian: Floats, covariance: Floats, log_volume: float) -> "Innovation":
        """From a linearisation of all rows that were measured and the covariance of the predicted state."""
        rows, derivatives = equivalent_rows(misfit, jacobian)
        return cls(rows, derivatives, _factor(derivatives, covariance), log_volume, len(misfit))

    def under(self, covariance: Floats) -> "Innovation":
        """The same rows with another covariance of the predicted state, shape (n_states, n_states)."""
        return replace(self, factor=_factor(self.jacobian, covariance))

    @cached_property
    def whitened(self) -> Floats:
        """The misfit in units of its own standard deviations, shape (n_equivalent,)."""
        return self.whiten(self.misfit)

    def whiten(self, rows: Floats) -> Floats:
        """Equivalent rows (n_equivalent,) or (n_equivalent, n) in standard deviations of the misfit."""
        # LAPACK complains of no rows.
        return np.asarray(lapack.dtrtrs(self.factor, rows, lower=True)[0]) if len(rows) else rows

    @property
    def squared(self) -> float:
        """Normalised innovation squared: chi-square with `dof` degrees of freedom if all is as modelled."""
        return float(self.whitened @ self.whitened)

    @property
    def log_likelihood(self) -> float:
        """Logarithm of the probability density of the rows, in their own units."""
        log_factor = float(np.log(self.factor.diagonal()).sum())
        return self.log_volume - log_factor - 0.5 * (self.squared + self.dof * _LOG_2_PI)


@dataclass(frozen=True, repr=False)
class Update(Brief):
    """Result of `update`."""

    state: State  # after the rows
    innovation: Innovation  # what they said beyond the prediction
    equivalent: Floats  # derivatives of the equivalent rows of `misfit` and `jacobian`, (n_equivalent, n_states)
    misfit: Floats  # whitened measurement minus the predicted state's, all rows linearised at the solution, (n_rows,)
    jacobian: Floats  # likewise, shape (n_rows, n_states)
    converged: bool  # whether the iteration came to rest

    @property
    def gain(self) -> Floats:
        """Kalman gain for the equivalent rows, P H' as their variance is one, shape (n_states, n_equivalent)."""
        return self.state.covariance @ self.equivalent.T

    def linearised(self, prior: State) -> Innovation:
        """The rows at the solution beyond `prior`, the state before them."""
        return Innovation.of(self.misfit, self.jacobian, prior.covariance, self.innovation.log_volume)


def predict(drift: DriftModel, state: State, time_h: float, temperature_c: float = float("nan")) -> State:
    """The state at a later time, before anything is measured then; an unlogged temperature is NaN, unchanged."""
    kelvin = kelvin_between(state.temperature_c, temperature_c)
    mean, covariance = drift.propagate(state.mean, state.covariance, time_h - state.time_h, kelvin)
    return State(time_h, mean, covariance, state.temperature_c if isnan(temperature_c) else temperature_c)


def kelvin_between(before: float, after: float) -> float:
    """Change of temperature, zero where either is not known."""
    change = after - before
    return 0.0 if isnan(change) else float(change)


def update(state: State, measurement: Measurement) -> Update:
    """Take in rows, one at least, that were measured at the time of `state`, which is predicted for it."""
    prior, covariance = state.mean, state.covariance
    misfit, jacobian = measurement.linearise(prior)
    innovation = Innovation.of(misfit, jacobian, covariance, measurement.log_volume)
    mean, pull = prior, np.zeros(len(prior))
    cost = float(misfit @ misfit)
    # Linear rows need no step: the exact update below is all there is.
    converged, last = isinstance(measurement, LinearMeasurement), np.inf
    for number in range(0 if converged else _MAX_STEPS):
        # The state is prior + covariance @ pull throughout.
        rows, derivatives = equivalent_rows(misfit + jacobian @ (mean - prior), jacobian)
        wanted = derivatives.T @ np.linalg.solve(derivatives @ (covariance @ derivatives.T) + np.eye(len(rows)), rows)
        step = wanted - pull
        length = float(np.sqrt(max(float(step @ covariance @ step), 0.0)))
        if length < _STEP_TOLERANCE:
            converged = True
            break
        # Where curvature makes the steps shrink slowly, one step takes the sum of those to come.
        slowness = length / last
        last = length
        if number >= _PATIENCE:
            step = _newton(measurement, covariance, mean, pull, misfit, jacobian)
        elif _SLOW < slowness < 1.0:
            step, last = step * min(1.0 / (1.0 - slowness), 20.0), np.inf
        for _ in range(10):
            trial = prior + covariance @ (pull + step)
            found, slope = measurement.linearise(trial)
            trial_cost = float(found @ found + (pull + step) @ (trial - prior))
            if trial_cost <= cost + _ROUNDING * (1.0 + cost):
                break
            step = step / 2.0
        else:
            converged = length < _AT_REST
            break
        mean, pull, misfit, jacobian, cost = trial, pull + step, found, slope, trial_cost
    # Linear in the state from here on: one exact update from the prediction.
    rows, derivatives = innovation.misfit, innovation.jacobian
    if mean is not prior:
        misfit = misfit + jacobian @ (mean - prior)
        rows, derivatives = equivalent_rows(misfit, jacobian)
    shift, left = kalman_update(np.zeros(len(prior)), covariance, rows, identity(len(rows)), derivatives)
    after = State(state.time_h, prior + shift, symmetric(left), state.temperature_c)
    return Update(after, innovation, derivatives, misfit, jacobian, converged)


def _newton(
    measurement: Measurement, covariance: Floats, mean: Floats, pull: Floats, misfit: Floats, jacobian: Floats
) -> Floats:
    """The step of `pull` by the full second derivatives; uphill directions are turned downhill."""
    bend, sd = np.zeros_like(covariance), np.sqrt(np.diag(covariance))
    for i in np.flatnonzero(sd > 0):
        shift = np.zeros_like(mean)
        shift[i] = 1e-3 * sd[i]
        ahead, behind = (measurement.linearise(mean + way * shift)[1] for way in (1.0, -1.0))
        bend[:, i] = (behind - ahead).T @ misfit / (2.0 * shift[i])
    second, root = jacobian.T @ jacobian + symmetric(bend), covariance_root(covariance)
    sizes, directions = np.linalg.eigh(np.eye(len(mean)) + symmetric(root.T @ second @ root))
    away = pull - jacobian.T @ misfit
    scores = -directions @ ((directions.T @ (root.T @ away)) / np.maximum(np.abs(sizes), 1e-3))
    return -away - second @ (root @ scores)


def inflate(state: State, sd: Floats) -> State:
    """The state after a jump of unknown size; `sd` is its standard deviation in the units of the state, (n_states,)."""
    return replace(state, covariance=state.covariance + np.diag(sd**2))


def kalman(state: State):  # type: ignore[no-untyped-def]
    """A filter of filterpy that holds a state."""
    filtered = KalmanFilter(len(state.mean), 1)
    filtered.x, filtered.P = state.mean, state.covariance
    return filtered


def take_rows(filtered: KalmanFilter, rows: Floats, derivatives: Floats) -> None:
    """Take whitened rows (n_rows,) with their derivatives (n_rows, n_states) into a filter of filterpy."""
    filtered.dim_z = len(rows)
    filtered.update(rows, R=np.eye(len(rows)), H=derivatives)


def _factor(jacobian: Floats, covariance: Floats) -> Floats:
    """Lower Cholesky factor of the covariance of whitened rows, by LAPACK itself: rows are often few."""
    spread = jacobian @ covariance @ jacobian.T + identity(len(jacobian))
    factor, failed = lapack.dpotrf(spread, lower=True, clean=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the rows is not positive definite")
    return np.asarray(factor)
