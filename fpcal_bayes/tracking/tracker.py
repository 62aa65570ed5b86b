"""Follow a cell through a campaign: full calibration first, then an update a session."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted, symmetric
from fpcal_bayes.core.notebook import Result
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.slips import find_slips
from fpcal_bayes.infer.fit.spectrum import GAUGE_SHARE, WEAK_SHARE
from fpcal_bayes.infer.posterior.draws import independent_draws
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.trust import MECHANICS_LEFT_OUT, POOR_FIT_BELOW, Reason, Trust
from fpcal_bayes.tracking.alarms import ROBOT_MOVED, Limits
from fpcal_bayes.tracking.drift import DriftModel, State, likely_drift
from fpcal_bayes.tracking.filter import kalman, take_rows
from fpcal_bayes.tracking.measurement import Measurement, SweepMeasurement, equivalent_rows
from fpcal_bayes.tracking.motions import MotionStates
from fpcal_bayes.tracking.session import SessionOutcome, followed_drift
from fpcal_bayes.tracking.sessions import check_sessions, mean_temperature
from fpcal_bayes.tracking.smoother import Smoothed, follow_sessions, smooth, with_measurements
from fpcal_bayes.tracking.solutions import likeliest, solutions_of
from fpcal_bayes.tracking.start import linear_start

#: Posterior draws whose moments the filter starts from.
_DRAWS = 2000
#: After so many sessions in a row whose updates stalled a full calibration is due.
_STALLED = 3
#: A first session that determines a smaller share of the free parameters is no calibration.
_CALIBRATED = 0.6


def _not_converged(stalled: list[str]) -> Reason:
    sessions = f"the update of session {', '.join(stalled)} did not converge"
    return Reason("not-converged", f"{sessions}: do not use this estimate before another session is taken in")


@dataclass(frozen=True)
class Track(Result):
    """What following a campaign gave."""

    cell: Cell  # what was followed
    drift: DriftModel  # how it drifts
    outcomes: tuple[SessionOutcome, ...]  # one per session, in order of time; the first is the calibration
    status: tuple[str, ...]  # of each parameter after the calibration
    resumed: int = 0  # how many of the outcomes were taken over from an earlier run
    solutions: int = 1  # how many the calibration has; see `tracking.solutions`
    data: dict[str, str] = field(default_factory=dict)  # of the file that was followed

    def __repr__(self) -> str:
        sessions = counted(len(self.outcomes), "session")
        return f"Track({sessions} of {self.cell.name!r}, last {self.last.session} {self.last.verdict})"

    def content(self) -> dict[str, Any]:
        """What ``track --json`` writes beside the estimate."""
        told = ("session", "time_h", "n_sweeps", "nis", "dof", "verdict")
        sessions = [{name: getattr(o, name) for name in told} | {"evidence": list(o.evidence)} for o in self.outcomes]
        return {"sessions": sessions, "calibration_due": self.calibration_due is not None}

    @property
    def last(self) -> SessionOutcome:
        """The latest session."""
        return self.outcomes[-1]

    @property
    def converged(self) -> bool:
        """Whether the calibration and the last update came to rest."""
        return self.outcomes[0].converged and self.last.converged

    @property
    def calibration_due(self) -> str | None:
        """The last session at which the robot itself was found to have moved, with no calibration since, or None."""
        due = None
        for outcome in self.outcomes:
            if outcome.dof >= len(self.drift.parameters):
                due = None
            elif outcome.verdict in ROBOT_MOVED:
                due = outcome.session
        return due

    @property
    def trust(self) -> Trust:
        """What is held against the last estimate: the fit of the calibration, updates that stalled, a moved robot."""
        found, stalled = self.lasting_trust, self._stalled
        if stalled and len(stalled) < _STALLED:
            found = found.because(_not_converged(stalled))
        return found

    @property
    def lasting_trust(self) -> Trust:
        """The same without what the next session may lift: up to two last updates that stalled."""
        found = self.outcomes[0].trust
        if self.cell.mechanics is not None and self.outcomes[0].motions is None:
            found = found.because(MECHANICS_LEFT_OUT)
        if self.drift.pace_note is not None:
            found = found.because(Reason("drift", self.drift.pace_note))
        if len(self._stalled) >= _STALLED:
            found = found.because(_not_converged(self._stalled))
        if self.calibration_due is not None:
            text = f"a full calibration is due: the robot itself moved before session {self.calibration_due}"
            found = found.because(Reason("intrinsics-moved", text))
        return found

    @property
    def _stalled(self) -> list[str]:
        """Names of the last sessions after the calibration whose updates did not converge, one after the other."""
        return [o.session for o in takewhile(lambda outcome: not outcome.converged, self.outcomes[:0:-1])][::-1]

    def estimate(self, valid_until_h: float | None = None) -> Estimate:
        """The current best estimate: the state after the last session."""
        now = estimate_of(self.cell, self.drift, self.last.state, self.status, self.data, valid_until_h)
        return replace(now, trust=self.trust)


def estimate_of(
    cell: Cell,
    drift: DriftModel,
    state: State,
    status: Sequence[str],
    data: dict[str, str] | None = None,
    valid_until_h: float | None = None,
) -> Estimate:
    """A state as an estimate; `status` is that after the calibration, weak where the variance is no longer halved."""
    covariance = drift.covariance(state.covariance)
    left = np.diag(covariance) / drift.scale**2
    now = tuple(
        s if s == "gauge" else "weak" if v > WEAK_SHARE else "identified" for s, v in zip(status, left, strict=True)
    )
    known = None
    if drift.motions is not None:
        n = drift.n_lengths
        known = drift.motions.knowledge(drift.parameters, drift.scale, state.mean[:n], state.covariance[:n, :n])
    values = drift.values(state.mean)
    return Estimate(
        cell, drift.parameters, values, covariance, now, state.time_h, valid_until_h, data or {}, mechanics=known
    )


def track(
    cell: Cell,
    sweeps: Sweeps,
    *,
    drift: DriftModel | None = None,
    limits: Limits | None = None,
    known: Track | None = None,
    now_h: float | None = None,
) -> Track:
    """Follow the free parameters of a cell through the measured sweeps of a campaign, whose first session is full.

    `drift` stands in place of `likely_drift`; sessions of `known`, an earlier track, are not taken in again; none may
    be after `now_h`. `InputError` for a cell without drift, sessions out of order, a first that is no calibration.
    """
    drift = likely_drift(cell, sweeps) if drift is None else drift
    limits = Limits() if limits is None else limits
    parts = check_sessions(sweeps, now_h)
    model = CavityModel.of(cell, drift.parameters)
    starts: tuple[tuple[SessionOutcome, float], ...] = ()
    if known is None:
        first, status, starts = calibrate(cell, drift, parts[0])
        known = Track(cell, drift, (first,), status, 0, max(1, len(starts)))
    else:
        known = replace(known, resumed=len(known.outcomes))
    hidden = followed_drift(drift, model, known.outcomes[0])
    outcomes = follow_sessions(hidden, model, limits, known.outcomes, parts)
    if starts:
        course = likeliest(drift, model, limits, outcomes, starts, parts)
        outcomes = follow_sessions(followed_drift(drift, model, course[0]), model, limits, course, parts)
    return replace(known, drift=hidden, outcomes=tuple(outcomes))


def smooth_track(track: Track, sweeps: Sweeps) -> Smoothed:
    """States after each session of a track given all sessions; see `smooth`."""
    model = CavityModel.of(track.cell, track.drift.parameters)
    parts = [sweeps.of_session(outcome.session) for outcome in track.outcomes]
    return smooth(track.drift, with_measurements(track.drift, model, Limits(), track.outcomes, parts))


def calibrate(
    cell: Cell, drift: DriftModel, sweeps: Sweeps
) -> tuple[SessionOutcome, tuple[str, ...], tuple[tuple[SessionOutcome, float], ...]]:
    """Outcome of the full first session, or `InputError`; status by parameter; of several minima outcome and share."""
    found, warnings = _identified(cell, drift, sweeps)
    if found.spectrum.rank < _CALIBRATED * len(drift.parameters):
        raise InputError(
            f"{sweeps.file}: session {sweeps.sessions[0]!r} is no calibration: its {len(found.problem.sweeps)} rows "
            f"determine {found.spectrum.rank} of {len(drift.parameters)} combinations of the parameters, expected the "
            "first session to be a full calibration"
        )
    if found.machine is not None:
        return _machine_outcome(drift, found, sweeps, warnings), found.estimate.status, ()
    measurement = _measurement(drift, found)

    def outcome_of(estimate: Estimate, squared: float, measurement: Measurement | None) -> SessionOutcome:
        return replace(start(drift, estimate, sweeps, found, warnings), nis=squared, measurement=measurement)

    draws = independent_draws(found, _DRAWS) if found.converged else np.zeros((0, found.problem.n_free))
    together = linear_start(found.estimate, draws, found.problem.sweeps) if len(draws) else found.estimate
    alone = solutions_of(found, draws)
    gauge = found.spectrum.null_share > GAUGE_SHARE
    status = tuple("gauge" if g else s for g, s in zip(gauge, found.estimate.status, strict=True))
    # Rows linearised at one point say nothing of a second solution.
    first = outcome_of(together, found.solution.sum_of_squares, None if alone else measurement)
    return first, status, tuple((outcome_of(one.estimate, one.sum_of_squares, measurement), one.share) for one in alone)


def _machine_outcome(
    drift: DriftModel, found: Identification, sweeps: Sweeps, warnings: tuple[str, ...]
) -> SessionOutcome:
    """The outcome of a calibration that knows geometry and error motions together, the sizes being the typical ones."""
    assert found.machine is not None
    problem = found.problem
    drift = replace(drift, motions=MotionStates.of(found.machine))
    first = start(drift, found.estimate, sweeps, found, warnings)
    taken = SweepMeasurement.of(drift, problem.model, problem.sweeps, first.state.mean)
    misfit, jacobian = replace(taken, target=problem.target).linearise(first.state.mean)
    rows, derivatives = equivalent_rows(misfit + jacobian @ first.state.mean, jacobian)
    filtered = kalman(replace(first.state, mean=np.zeros(drift.n_states), covariance=np.eye(drift.n_states)))
    take_rows(filtered, rows, derivatives)
    measurement = replace(SweepMeasurement.of(drift, problem.model, problem.sweeps, filtered.x), target=problem.target)
    return replace(
        first,
        state=replace(first.state, mean=filtered.x, covariance=symmetric(filtered.P)),
        motions=drift.motions,
        measurement=measurement if found.converged and not problem.prior.others else None,
    )


def calibration_measurement(cell: Cell, drift: DriftModel, sweeps: Sweeps) -> Measurement | None:
    """The rows of a calibration as `calibrate` takes them in, for its outcome."""
    return _measurement(drift, _identified(cell, drift, sweeps)[0])


def start(
    drift: DriftModel, estimate: Estimate, sweeps: Sweeps, found: Identification, warnings: tuple[str, ...]
) -> SessionOutcome:
    """The outcome of the calibration `found`, from its estimate or another of the same parameters."""
    values, covariance = estimate.block(drift.parameters.names)
    state = State(float(sweeps.time_h.max()), *drift.initial(values, covariance), mean_temperature(sweeps))
    rows = len(found.problem.sweeps)
    return SessionOutcome(
        session=str(sweeps.session[0]),
        time_h=state.time_h,
        utc=str(sweeps.utc[-1]),
        predicted=state,
        state=state,
        jump=np.zeros(drift.n_states),
        n_sweeps=rows,
        # The calibration's own innovation is its sum of squares against the prior.
        nis=found.solution.sum_of_squares,
        dof=rows,
        warnings=warnings + found.warnings,
        converged=found.converged,
        trust=found.estimate.trust,
    )


def _identified(cell: Cell, drift: DriftModel, sweeps: Sweeps) -> tuple[Identification, tuple[str, ...]]:
    found = identify(cell, sweeps, free=drift.parameters.names)
    slipped = any(reason.kind == "slips" for reason in found.estimate.trust.reasons)
    return _without_slips(cell, drift, found) if slipped or found.fit.p_value < POOR_FIT_BELOW else (found, ())


def _measurement(drift: DriftModel, found: Identification) -> Measurement | None:
    """The rows by which a trajectory can begin at the prior; None where that is not normal and as stated."""
    problem = found.problem
    as_stated = np.array_equal(problem.prior.sd, problem.model.free.prior_sd)
    if not found.converged or problem.prior.others or problem.considered is not None or not as_stated:
        return None
    return SweepMeasurement(drift, problem.model, problem.rows, problem.target, problem.whitening)


def _without_slips(cell: Cell, drift: DriftModel, found: Identification) -> tuple[Identification, tuple[str, ...]]:
    """The identification with slipped fringe counts corrected, if that is what spoils it."""
    slips = find_slips(found.problem, found.solution)
    rows = np.flatnonzero(slips.counts)
    if not len(rows):
        return found, ()
    used = found.problem.sweeps
    again = identify(
        cell,
        replace(used.with_measurement(slips.problem.target, used.sigma), signed=np.ones(len(used), dtype=bool)),
        free=drift.parameters.names,
    )
    named = ", ".join(f"{used.label[i]} ({-slips.counts[i]:+d})" for i in rows)
    return again, (f"fringe counts slipped, corrected by whole half wavelengths: {named}",)
