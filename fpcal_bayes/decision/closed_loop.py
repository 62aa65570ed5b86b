"""A policy in charge of a cell: it says when to measure what, and the filter takes in what was measured.

The cell is behind a function that measures a plan, simulated or real. How well the robot did meanwhile is judged
afterwards, by the estimates that the controller held and a truth that is known in simulation only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.decision import Decision
from fpcal_bayes.decision.diagnosis import is_diagnosis
from fpcal_bayes.decision.forecast import Forecast
from fpcal_bayes.decision.policy import Policy
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_errors
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.tracking.session import SessionOutcome, take_in
from fpcal_bayes.tracking.smoother import looked_at_again
from fpcal_bayes.tracking.start import with_hidden_noise

#: Measures a plan at a time in hours.
Measure = Callable[[Sweeps, float], Sweeps]


@dataclass(frozen=True)
class ClosedLoop:
    """What a policy did.

    Attributes
    ----------
    outcomes
        One a session, the calibration first.
    sweeps
        Measured, one set a session after the calibration.
    decisions
        That ordered each of these sessions.
    """

    outcomes: tuple[SessionOutcome, ...]
    sweeps: tuple[Sweeps, ...]
    decisions: tuple[Decision, ...]

    @property
    def held(self) -> list[tuple[float, Floats]]:
        """From when on the controller held which state, shape (n_states,) each."""
        return [(outcome.time_h, outcome.state.mean) for outcome in self.outcomes]


def run_policy(
    policy: Policy, start: SessionOutcome, measure: Measure, end_h: float, *, step_h: float = 0.05
) -> ClosedLoop:
    """Let a policy run from a calibration on.

    Parameters
    ----------
    start
        The calibration.
    measure
        Measures a plan.
    end_h
        When the last session may begin, in hours since the campaign began.
    step_h
        Sessions begin on multiples of this, the last one at which the tolerance is still expected to hold.

    Raises
    ------
    InputError
        If the tolerance cannot be met.
    """
    policy = replace(policy, drift=with_hidden_noise(policy.drift, policy.model, start.state))
    outcomes = [start]
    measured: list[Sweeps] = []
    decisions: list[Decision] = []
    diagnosed, now = start.time_h, start.time_h
    while True:
        last = outcomes[-1]
        forecast = Forecast.of(policy.drift, policy.model, policy.goal, last.state.mean)
        due = f"the robot itself moved before session {last.session}" if last.verdict == "intrinsics-moved" else None
        state = forecast.ahead(last.state, now - last.time_h)
        # A session too many is dearer than one a few minutes late: it is planned for the end of the hold.
        hold = 0.0 if due else policy.hold_hours(forecast, state, diagnosed)
        now = (np.floor(now / step_h + 1e-6) + max(1.0, np.floor(hold / step_h + 1e-6))) * step_h
        if now > end_h + 1e-9:
            return ClosedLoop(tuple(outcomes), tuple(measured), tuple(decisions))
        decision = policy.measure_now(forecast, forecast.ahead(last.state, now - last.time_h), due, diagnosed)
        assert decision.sweeps is not None
        taken = measure(decision.sweeps, now)
        outcomes.append(take_in(policy.drift, policy.model, policy.limits, last.state, last.monitor, taken))
        outcomes[-1] = looked_at_again(policy.drift, outcomes)
        measured.append(taken)
        decisions.append(decision)
        if is_diagnosis(policy.drift, policy.model, last, outcomes[-1], taken, policy.limits):
            diagnosed = now


def task_peaks(
    model: CavityModel,
    truth: Truth,
    held: Sequence[tuple[float, Floats]],
    tasks: Sequence[str],
    times_h: Floats,
    *,
    radius: float = 100.0,
) -> Floats:
    """Peak to peak of the error of tasks while a controller holds one estimate after the other.

    Parameters
    ----------
    model
        Of the free parameters.
    truth
        Of the same parameters, or more.
    held
        From when on which free parameters (n_free,) were held, in um and rad, in order of time.
    times_h
        Where to look, none before the first estimate, shape (t,).

    Returns
    -------
    ndarray
        In um, shape (n_tasks, t).
    """
    columns = truth.parameters.positions(model.free.names)
    peaks = np.zeros((len(tasks), len(times_h)))
    begins = np.array([time for time, _ in held])
    number = np.searchsorted(begins, times_h + 1e-9) - 1
    for i in np.unique(number):
        here = number == i
        values = held[i][1]
        true = truth.at(times_h[here])[:, columns]
        for row, name in enumerate(tasks):
            task = find_task(model.cell, model.vector(values), name, radius=radius).driven()
            peaks[row, here] = peak_to_peak(task_errors(model, true, values, task))
    return peaks
