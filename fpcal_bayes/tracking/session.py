"""One session: predict, take it in, judge it, and widen what has moved."""

from dataclasses import dataclass, field, replace

import numpy as np

from fpcal_bayes.core.linalg import chi2_tail, counted
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.sharing import sweep_numbers
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.tracking.alarms import ROBOT_MOVED, Finding, Limits, Monitor, SessionVerdict, extend, findings
from fpcal_bayes.tracking.corrections import correct_slips, outlying_sweep, with_signs
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.filter import Innovation, Update, inflate, kelvin_between, predict, update
from fpcal_bayes.tracking.measurement import Measurement, SweepMeasurement
from fpcal_bayes.tracking.motions import MotionStates
from fpcal_bayes.tracking.sessions import mean_temperature
from fpcal_bayes.tracking.start import with_hidden_noise

#: Rows that lie closer to the prediction than chance allows this often have too large a sigma.
_TOO_GOOD = 1e-6
#: Sizes of a knock that are tried, in units of `Limits.jump`.
_STEP_SIZES = (1.0, 3.0, 10.0)
#: So many sweeps of a session are set aside at most, one in three; their readings then count for nothing.
_MOST_OUTLIERS, _SET_ASIDE = 2, 1e3


@dataclass(frozen=True, repr=False)
class SessionOutcome(Brief):
    """What a session said and what was made of it."""

    session: str  # its name
    time_h: float  # its last time
    utc: str  # the same as clock time, or empty
    predicted: State  # before the session, without a widening
    state: State  # after it
    jump: Floats  # sd by which the predicted state was widened, shape (n_states,); zero if all is as modelled
    monitor: Monitor = field(default_factory=Monitor)  # memory of the tests after it
    n_sweeps: int = 0  # rows that were used
    nis: float = 0.0  # normalised innovation squared, not divided
    dof: int = 0  # its degrees of freedom
    verdict: SessionVerdict = "as-modelled"  # whether all is as modelled
    evidence: tuple[str, ...] = ()  # in words what speaks against it
    warnings: tuple[str, ...] = ()  # sentences about rows that were corrected or left out
    log_likelihood: float = 0.0  # of the rows given all sessions before
    converged: bool = True  # whether the update came to rest; else its rows are left out
    # the rows as they were taken in, signs decided and slips corrected; None if none were, if the outcome is read from
    # a file, or if a calibration cannot be linearised again (see `tracker.calibrate`)
    measurement: Measurement | None = field(default=None, compare=False, repr=False)
    trust: Trust = field(default_factory=Trust)  # what is held against the fit of a calibration
    motions: MotionStates | None = field(default=None, compare=False, repr=False)  # of a machine, from its calibration


def take_in(
    drift: DriftModel, model: CavityModel, limits: Limits, state: State, monitor: Monitor, sweeps: Sweeps
) -> SessionOutcome:
    """Take in the sweeps of one session later than `state`, which stands with `monitor` after the one before."""
    session, time_h, temperature = str(sweeps.session[0]), float(sweeps.time_h.max()), mean_temperature(sweeps)
    hours = time_h - state.time_h
    predicted = predict(drift, state, time_h, temperature)
    used = sweeps.take(sweeps.kind != "path")
    warnings = [f"{counted(len(sweeps) - len(used), 'row')} of kind path not used"] if len(used) < len(sweeps) else []
    used, left_out = with_signs(drift, model, predicted, used)
    warnings += left_out
    outcome = SessionOutcome(
        session, time_h, str(sweeps.utc[-1]), predicted, predicted, np.zeros(drift.n_states), monitor
    )
    if not len(used):
        return replace(outcome, warnings=tuple(warnings))
    matrix = drift.transition(hours, kelvin_between(state.temperature_c, temperature)).matrix
    judge = _Judge(drift, limits, session, hours, matrix, monitor, predicted)
    judged = judge.judged(SweepMeasurement.of(drift, model, used, predicted.mean))
    innovation = judged.taken.innovation
    if chi2_tail(innovation.squared, innovation.dof) > 1.0 - _TOO_GOOD:
        warnings.append(
            f"the {innovation.dof} rows lie far closer to what was predicted than sigma_um says (innovation "
            f"{innovation.squared:.2g}, expected {innovation.dof}): sigma_um is too large, so that they tell next to "
            "nothing"
        )
    if judged.found:
        dl, said = correct_slips(used, judged.measurement, innovation, predicted, judge.jumps())
        warnings += said
        if (dl != used.dl).any():
            judged = judge.judged(replace(judged.measurement, target=dl))
    if judged.found and drift.motions is not None:
        judged, said = judge.without_outliers(used, judged)
        warnings += said
    outcome = replace(
        outcome,
        monitor=judged.after,
        n_sweeps=len(used),
        nis=judged.taken.innovation.squared,
        dof=innovation.dof,
        warnings=tuple(warnings),
        log_likelihood=judged.taken.innovation.log_likelihood,
        measurement=judged.measurement,
    )
    wide, taken = predicted, judged.taken
    if judged.found:
        verdict, found, jump = judge.explain(judged.measurement, judged.found)
        wide = inflate(predicted, jump)
        taken = update(wide, judged.measurement)
        evidence = tuple(finding.evidence for finding in found)
        # After a change of the robot nothing is remembered; else only one at this session is still looked for.
        moved = verdict in ROBOT_MOVED
        after = Monitor() if moved else judge.extended(Monitor(), taken.linearised(wide), taken.gain)
        outcome = replace(outcome, jump=jump, verdict=verdict, evidence=evidence, monitor=after)
    if taken.converged:
        return replace(outcome, state=taken.state)
    # What the rows say cannot be told: what was known before them stays.
    warnings.append(f"{counted(len(used), 'row')} left out: their update did not converge")
    after = Monitor() if judged.found else monitor
    nothing = replace(outcome, n_sweeps=0, nis=0.0, dof=0, log_likelihood=0.0, measurement=None)
    return replace(nothing, state=wide, monitor=after, converged=False, warnings=tuple(warnings))


@dataclass(frozen=True)
class _Judged:
    """A session as it was taken in, the memory of the tests after it, and those that fail."""

    measurement: SweepMeasurement
    taken: Update
    after: Monitor
    found: list[Finding]


@dataclass(frozen=True)
class _Judge:
    drift: DriftModel
    limits: Limits
    session_name: str
    hours: float
    matrix: Floats
    monitor: Monitor
    predicted: State

    def step(self, size: float) -> Floats:
        """Standard deviations of a jump of mirror and fibre, shape (n_states,)."""
        return self._states(np.where(self.drift.extrinsic, size * self.limits.jump(self.drift), 0.0))

    def jumps(self) -> tuple[Floats, ...]:
        return *(self.step(size) for size in _STEP_SIZES), self._states(self.limits.jump(self.drift))

    def judged(self, measurement: SweepMeasurement) -> _Judged:
        taken = update(self.predicted, measurement)
        after = self.extended(self.monitor, taken.linearised(self.predicted), taken.gain)
        return _Judged(measurement, taken, after, findings(after, self.limits, self.drift))

    def without_outliers(self, used: Sweeps, as_it_is: _Judged) -> tuple[_Judged, list[str]]:
        """The session with sweeps set aside whose heavy-tailed noise explains all that failed; else as it is."""
        judged, sigma, left = as_it_is, used.sigma.copy(), []
        for _ in range(min(_MOST_OUTLIERS, int(sweep_numbers(used)[-1] + 1) // 3)):
            rows = outlying_sweep(used, judged.measurement, judged.taken.innovation, self.predicted, self.jumps())
            if rows is None:
                break
            sigma[rows] *= _SET_ASIDE
            left.append(str(used.label[rows[0]]))
            aside = used.with_measurement(as_it_is.measurement.target, sigma)
            judged = self.judged(SweepMeasurement.of(self.drift, judged.measurement.model, aside, self.predicted.mean))
            if not judged.found:
                return judged, [f"read far off, where no change of the cell puts it, and left out: {', '.join(left)}"]
        return as_it_is, []

    def explain(
        self, measurement: SweepMeasurement, found: list[Finding]
    ) -> tuple[SessionVerdict, list[Finding], Floats]:
        """What moved, why, and the sd of the widening; the tests are made again where the best knock leads."""
        tried = []
        for size in _STEP_SIZES:
            wide = inflate(self.predicted, self.step(size))
            at_solution = update(wide, measurement).linearised(wide)
            tried.append((at_solution.log_likelihood, size, at_solution))
        _, size, knocked = max(tried, key=lambda entry: entry[0])
        innovation = knocked.under(self.predicted.covariance)
        # Kalman gain of the linearisation.
        spread = innovation.jacobian @ self.predicted.covariance
        gain = np.linalg.solve(innovation.factor.T, innovation.whiten(spread)).T
        again = self.extended(self.monitor, innovation, gain)
        anew = findings(again, self.limits, self.drift, knocked.log_likelihood - innovation.log_likelihood)
        intrinsic = [finding for finding in anew if finding.verdict == "intrinsics-moved"]
        if intrinsic:
            wider = np.maximum(self._states(self.limits.jump(self.drift)), self.step(size))
            return self._of_the_robot(innovation, intrinsic, wider, self.step(size))
        extrinsic = [finding for finding in anew or found if finding.verdict == "extrinsics-moved"]
        return "extrinsics-moved", extrinsic or found, self.step(size)

    def _of_the_robot(
        self, innovation: Innovation, found: list[Finding], every: Floats, step: Floats
    ) -> tuple[SessionVerdict, list[Finding], Floats]:
        """Whether the geometry changed, one parameter or all, or the error motions, which are then drawn anew."""
        if self.drift.motions is None:
            return "intrinsics-moved", found, every
        n, m, covariance = self.drift.n_parameters, self.drift.n_lengths, self.predicted.covariance
        moved = np.zeros(len(step))
        # The old motions and the new ones differ by twice the variance, less what was known of the old ones.
        moved[n:m] = np.sqrt(1.0 + np.clip(1.0 - np.diag(covariance)[n:m], 0.0, None))
        singles = [np.maximum(step, np.where(np.arange(len(step)) == i, every, 0.0)) for i in range(n)]

        def likely(jump: Floats) -> float:
            return innovation.under(covariance + np.diag(jump**2)).log_likelihood

        geometry = max(*(likely(jump) for jump in singles), likely(every))
        moved = max((np.maximum(step, size * moved) for size in _STEP_SIZES), key=likely)
        odds = likely(moved) - geometry
        if odds <= 0.0:
            return "intrinsics-moved", found, every
        text = f"the error motions of the joints changed: that is likelier than a change of the geometry (e^{odds:.0f})"
        finding = replace(found[0], verdict="mechanics-moved", evidence=text)
        return "mechanics-moved", [finding, *found], np.maximum(every, moved)

    def extended(self, monitor: Monitor, innovation: Innovation, gain: Floats) -> Monitor:
        return extend(monitor, self.session_name, self.hours, innovation, gain, self.matrix, self.limits, self.drift)

    def _states(self, parameters: Floats) -> Floats:
        result = np.zeros(self.drift.n_states)
        result[: self.drift.n_parameters] = parameters
        return result


def followed_drift(drift: DriftModel, model: CavityModel, first: SessionOutcome) -> DriftModel:
    """The drift as the filter has it after the calibration `first`: with its error motions and its `hidden` noise."""
    return with_hidden_noise(replace(drift, motions=first.motions), model, first.state)
