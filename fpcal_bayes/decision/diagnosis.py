"""Looking at the robot itself: which sessions can show that an intrinsic parameter changed.

A change of the robot shows only beside what mirror and fibre may have done at the same time; a session of few sweeps
that keeps a task may be blind to it. Its power is known before it is measured.
"""

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.alarms import Limits, power
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.filter import Innovation
from fpcal_bayes.tracking.measurement import SweepMeasurement
from fpcal_bayes.tracking.session import SessionOutcome
from fpcal_bayes.tracking.tracker import Track

#: A session counts as a look at the robot if it shows a change with this share of the probability with which reading
#: every parameter would. The rest is lost to the drift since, which hides the change from any session.
ENOUGH = 0.5
#: A look is planned only if some session could show a change with this probability: five such find two in three.
LEAST_POWER = 0.2
#: How closely that reading tells the parameters, in units of their prior standard deviation.
_EXACT = 1e-4


def watched(drift: DriftModel, limits: Limits) -> int:
    """Position of the intrinsic parameter that moves most, in units of the jumps that are looked for."""
    return int(np.argmax(np.where(drift.extrinsic, -1.0, drift.walk / limits.jump(drift))))


def session_power(
    drift: DriftModel, model: CavityModel, state: State, sweeps: Sweeps, hours: float, limits: Limits
) -> Floats:
    """Probability that sweeps, `hours` after the last session, show a jump of each parameter, shape (n_parameters,)."""
    planned = sweeps.with_measurement(np.zeros(len(sweeps)), sweeps.sigma)
    misfit, jacobian = SweepMeasurement.of(drift, model, planned, state.mean).linearise(state.mean)
    return power(Innovation.of(misfit, jacobian, state.covariance, 0.0), hours, limits, drift)


def most_power(drift: DriftModel, state: State, hours: float, limits: Limits) -> Floats:
    """The same if every parameter could be read by itself: no sweeps can do more."""
    reading = np.eye(drift.n_parameters, drift.n_states) / _EXACT
    return power(Innovation.of(np.zeros(len(reading)), reading, state.covariance, 0.0), hours, limits, drift)


def last_diagnosis(track: Track, sweeps: Sweeps, limits: Limits) -> float:
    """When a session could last show a change of the robot, in hours since the campaign began."""
    drift, model = track.drift, CavityModel.of(track.cell, track.drift.parameters)
    for number in range(len(track.outcomes) - 1, 0, -1):
        outcome, before = track.outcomes[number], track.outcomes[number - 1]
        if is_diagnosis(drift, model, before, outcome, sweeps.of_session(outcome.session), limits):
            return outcome.time_h
    return track.outcomes[0].time_h


def is_diagnosis(
    drift: DriftModel,
    model: CavityModel,
    before: SessionOutcome,
    outcome: SessionOutcome,
    sweeps: Sweeps,
    limits: Limits,
) -> bool:
    """Whether the session of `outcome` could show a change of the robot, `before` being the outcome before it."""
    rows = sweeps.take(sweeps.kind != "path")
    if not len(rows) or not outcome.converged:
        return False
    at, hours = watched(drift, limits), outcome.time_h - before.time_h
    most = most_power(drift, outcome.predicted, hours, limits)[at]
    return bool(session_power(drift, model, outcome.predicted, rows, hours, limits)[at] >= ENOUGH * most)
