"""What all sessions together say about every time: the Rauch-Tung-Striebel smoother of filterpy."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fpcal_bayes.track.drift import DriftModel
from fpcal_bayes.track.filter import State, kelvin_between
from fpcal_bayes.track.step import SessionOutcome


def smooth(drift: DriftModel, outcomes: Sequence[SessionOutcome]) -> list[State]:
    """States after each session given all sessions, in order of time.

    Widenings after a jump count as noise of the step before their session.

    Parameters
    ----------
    outcomes
        From the calibration on, as `track` gives them.
    """
    from filterpy.kalman import KalmanFilter

    states = [outcome.state for outcome in outcomes]
    matrices, noises = [np.eye(drift.n_states)], [np.zeros((drift.n_states, drift.n_states))]
    # A known temperature coefficient shifts the prediction: the smoother is run on what is left without the shifts.
    shifts = [np.zeros(drift.n_states)]
    for before, outcome in zip(states, outcomes[1:], strict=False):
        now = outcome.predicted
        kelvin = kelvin_between(before.temperature_c, now.temperature_c)
        step = drift.transition(now.time_h - before.time_h, kelvin)
        matrices.append(step.matrix)
        noises.append(step.noise + np.diag(outcome.jump**2))
        shifts.append(step.matrix @ shifts[-1] + step.shift)
    means = np.array([state.mean - shift for state, shift in zip(states, shifts, strict=True)])
    covariances = np.array([state.covariance for state in states])
    # The method of the class uses the transition into each time; the function of the module does not.
    smoothed, spread, _, _ = KalmanFilter(drift.n_states, 1).rts_smoother(means, covariances, matrices, noises)
    return [
        replace(state, mean=mean + shift, covariance=(covariance + covariance.T) / 2.0)
        for state, mean, shift, covariance in zip(states, smoothed, shifts, spread, strict=True)
    ]
