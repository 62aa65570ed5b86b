"""A campaign read, followed through its sessions, and all that its report says, worked out before anything is drawn."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fpcal_bayes.analysis.tasks import TaskNumbers, judged
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.core.linalg import quantile_band
from fpcal_bayes.decision.decision import Costs, Decision
from fpcal_bayes.decision.forecast import Forecaster, Goal
from fpcal_bayes.decision.policy import decide_track
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.observability.observe import Observability, observe
from fpcal_bayes.infer.posterior.netcdf import PosteriorSummary, read_posterior_summary
from fpcal_bayes.infer.tasks.budget import Budget, budget_of
from fpcal_bayes.infer.tasks.prediction import BAND, TaskPrediction, predict_from_covariance
from fpcal_bayes.infer.tasks.source import path_points
from fpcal_bayes.infer.verification.verify import Verification, read_verification
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.sweeps import is_campaign_file, read_sweeps
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.motion.compensation import compensated
from fpcal_bayes.motion.tasks import Task, find_task, possible_tasks
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import likely_drift
from fpcal_bayes.tracking.fit_sizes import with_learnt_pace
from fpcal_bayes.tracking.record import resume
from fpcal_bayes.tracking.sessions import check_sessions, hours_at, hours_now, hours_of
from fpcal_bayes.tracking.tracker import Track, estimate_of, track

#: Errors that are drawn of each task.
_DRAWS = 4000
#: Sessions of a campaign after which the pace of its drift is looked at first.
_LEARNT_FIRST = 16
#: Longest time between two sessions that can show a change of the robot itself, as `fpcal decide` has it.
_DIAGNOSIS_H = 24.0


@dataclass(frozen=True)
class _Measured:
    file: str | Path
    cell: Cell
    sweeps: Sweeps  # of all sessions
    parts: list[Sweeps]  # of each session, in order of time
    campaign: Campaign | None  # what the file holds beside the sweeps; None if it is a CSV
    now_h: float | None  # the time that the user gave
    data: dict[str, str]  # name of the file, and hash of its bytes

    @classmethod
    def read(cls, file: str | Path, cell: Cell, now: str | float | None) -> "_Measured":
        campaign = read_campaign(file, cell) if is_campaign_file(file) else None
        sweeps = read_sweeps(file, cell) if campaign is None else campaign.sweeps
        now_h = hours_at(now, sweeps) if isinstance(now, float) else None if now is None else hours_of(now, sweeps)
        data = {"file": Path(file).name, "sha256": file_sha256(Path(file))}
        return cls(file, cell, sweeps, check_sessions(sweeps, now_h), campaign, now_h, data)

    def follow(self, *, anew: bool = False) -> tuple[Track, list[str]]:
        """The track, from where a saved one ends, and sentences about the saved one; see `follow`."""
        cell, sweeps = self.cell, self.sweeps
        drift, limits = likely_drift(cell, sweeps), Limits()
        known, note = None, ""
        if self.campaign is not None and self.campaign.track is not None and not anew:
            known, note = resume(self.campaign.track, cell, drift, limits, self.parts, str(self.file))

        # Where drift is not as stated, the first sessions say so, and the others cost less under what they say. A track
        # that is taken up knows that, and stays as it is if there is nothing new.
        begun, resumed, found = min(_LEARNT_FIRST, len(self.parts)), 0 if known is None else len(known.outcomes), known
        for count in dict.fromkeys((begun, len(self.parts))):
            if count <= resumed:
                continue
            rows = sweeps if count == len(self.parts) else join(self.parts[:count], file=sweeps.file)

            def taken(known: Track | None, rows: Sweeps = rows) -> Track:
                paced = drift if known is None else replace(drift, pace=known.drift.pace)
                return track(cell, rows, drift=paced, limits=limits, known=known, now_h=self.now_h)

            found = with_learnt_pace(taken(found), self.parts, taken)
        assert found is not None
        found = replace(found, resumed=resumed)
        notes = [text for text in (note, found.drift.pace_note) if text]
        return replace(found, data=self.data | {"session": found.last.session}), notes


@dataclass(frozen=True)
class Followed:
    """A campaign as it was read and followed."""

    track: Track  # up to the last session
    sweeps: Sweeps  # all rows
    now_h: float | None  # the time that the user gave
    notes: list[str]  # sentences about what was saved before
    campaign: Campaign | None  # None if the file is a CSV


def follow(file: str | Path, cell: Cell, *, now: str | float | None = None, anew: bool = False) -> Followed:
    """Follow a campaign from its saved track on, or `anew`; none after `now`: hours, a clock time, a Unix time."""
    measured = _Measured.read(file, cell, now)
    warm_up(cell)
    found, notes = measured.follow(anew=anew)
    if found.last.utc:
        found = replace(found, data=found.data | {"utc": found.last.utc})
    return Followed(found, measured.sweeps, measured.now_h, notes, measured.campaign)


@dataclass(frozen=True)
class TaskStanding:
    """What is expected of one task now."""

    name: str
    asked: bool  # whether the cell must hold it
    task: Task | None  # its path, or None where it cannot be driven
    prediction: TaskPrediction | None
    numbers: TaskNumbers | None  # of the prediction
    reason: str = ""  # why it cannot be driven
    risk: float | None = None  # the largest probability of passing a tolerance, of the goal or the task's own


@dataclass(frozen=True)
class CampaignFacts:
    """Everything that a report shows."""

    file: str  # name of the campaign file, without its folder
    sha256: str
    cell: Cell
    sweeps: Sweeps
    campaign: Campaign | None  # what the file holds beside the sweeps; None if it is a CSV
    goal: Goal
    costs: Costs
    now_h: float  # time that the report is for, in hours since the campaign began
    observability: Observability  # of the first session: the calibration
    track: Track | None  # all sessions followed
    track_reason: str  # why they cannot be
    forecast: Forecaster | None  # of the last estimate; None where tasks cannot be judged
    decision: Decision | None  # what to do now
    decision_reason: str  # why that cannot be said
    estimate: Estimate  # what the controller holds, with the covariance of the truth now
    tasks: tuple[TaskStanding, ...]
    budget: Budget | None  # of the first task that must be held, after the calibration
    budget_reason: str  # why there is none
    posterior: PosteriorSummary | None  # of the calibration
    verification: Verification | None  # of the calibration
    command: str  # that made the report

    @property
    def calibration(self) -> Identification:
        """What the first session told."""
        found = self.observability.identification
        # Sessions are measured, so that the first one was identified.
        assert found is not None
        return found

    @property
    def trust(self) -> Trust:
        """What is held against the numbers of the page."""
        found = self.calibration.estimate.trust if self.track is None else self.track.trust
        return found if self.verification is None else found.because(*self.verification.reasons)

    @property
    def fit_is_wrong(self) -> bool:
        """Whether nothing on the page is to be used, of any time, since it rests on a fit that is wrong."""
        return not (self.calibration.estimate.trust if self.track is None else self.track.outcomes[0].trust).usable


def gather(
    file: str | Path,
    cell: Cell,
    *,
    goal: Goal | None = None,
    now: str | None = None,
    posterior: str | Path | None = None,
    verification: str | Path | None = None,
    command: str = "",
) -> CampaignFacts:
    """Read a campaign and work out all that its report says; arguments as in `write_campaign_report`."""
    goal = Goal(50.0) if goal is None else goal
    path = Path(file)
    measured = _Measured.read(path, cell, now)
    sweeps, parts = measured.sweeps, measured.parts
    draws = None if posterior is None else read_posterior_summary(posterior, cell)
    observability = observe(cell, parts[0])
    followed, track_reason = None, ""
    try:
        followed, _ = measured.follow()
    except InputError as error:
        track_reason = str(error)
    last_h = float(parts[-1].time_h.max())
    now_h = hours_now(sweeps, last_h) if measured.now_h is None else measured.now_h
    if now_h < last_h:
        raise InputError(f"{path}: now is {now_h:g} h, before the last session at {last_h:g} h: expected a time after")
    costs = Costs(sigma_nm=1e3 * float(np.median(sweeps.sigma)), diagnosis_h=_DIAGNOSIS_H)
    forecast, decision, decision_reason = _decide(followed, sweeps, goal, costs, now_h)
    found = observability.identification
    assert found is not None
    first = replace(found.estimate, data={"session": parts[0].sessions[0]})
    verified = None if verification is None else read_verification(verification, first)
    estimate = found.estimate if followed is None else _estimate_now(followed, now_h)
    judged = [*goal.tasks, *(name for name in possible_tasks(cell) if name not in goal.tasks)]
    budget, budget_reason = _budget(found, goal)
    return CampaignFacts(
        file=path.name,
        sha256=measured.data["sha256"],
        cell=cell,
        sweeps=sweeps,
        campaign=measured.campaign,
        goal=goal,
        costs=costs,
        now_h=now_h,
        observability=observability,
        track=followed,
        track_reason=track_reason,
        forecast=forecast,
        decision=decision,
        decision_reason=decision_reason,
        estimate=estimate,
        tasks=tuple(_as_decided(_outlook(estimate, each, goal), forecast, decision) for each in judged),
        budget=budget,
        budget_reason=budget_reason,
        posterior=draws,
        verification=verified,
        command=command,
    )


def _decide(
    followed: Track | None, sweeps: Sweeps, goal: Goal, costs: Costs, now_h: float
) -> tuple[Forecaster | None, Decision | None, str]:
    """The forecast of the last estimate and the decision, or None for what cannot be had, and why."""
    if followed is None:
        return None, None, "the sessions cannot be followed, so that nothing is known about drift"
    model = CavityModel.of(followed.cell, followed.drift.parameters)
    try:
        forecast = Forecaster.of(followed.drift, model, goal, followed.last.state.mean)
    except InputError as error:
        return None, None, str(error)
    try:
        return forecast, decide_track(followed, sweeps, goal, costs, now_h), ""
    except InputError as error:
        return forecast, None, str(error)


def _estimate_now(followed: Track, now_h: float) -> Estimate:
    """What the controller holds, with the covariance that the truth has around it now."""
    state, drift = followed.last.state, followed.drift
    _, covariance = drift.propagate(state.mean, state.covariance, now_h - state.time_h)
    grown = replace(state, time_h=now_h, covariance=covariance)
    return replace(estimate_of(followed.cell, drift, grown, followed.status, followed.data), trust=followed.trust)


def _outlook(estimate: Estimate, name: str, goal: Goal) -> TaskStanding:
    try:
        path = find_task(estimate.cell, estimate.vector(), name, radius=goal.radius_um, n_points=path_points(estimate))
        task = compensated(estimate, path) if goal.compensate else path
        prediction = predict_from_covariance(estimate, task.driven(), draws=_DRAWS)
        numbers = TaskNumbers.of(prediction, goal.tolerance_um)
        own = {each.name: each for each in estimate.cell.tasks}
        risks = [numbers.exceeds, *(judged(prediction, own[name]).values() if name in own else [])]
        risk = max((each for each in risks if each is not None), default=None)
        return TaskStanding(name, name in goal.tasks, task, prediction, numbers, risk=risk)
    except InputError as error:
        return TaskStanding(name, name in goal.tasks, None, None, None, str(error))


def _as_decided(told: TaskStanding, forecast: Forecaster | None, decision: Decision | None) -> TaskStanding:
    """A task that must be held, in the numbers that the decision rests on, so that the page has one of each."""
    if not told.asked or told.numbers is None or told.risk is None or forecast is None or decision is None:
        return told
    i = forecast.goal.tasks.index(told.name)
    if forecast.counts[i] > 1:  # held to other degrees of freedom too, all in one
        return told
    widths = 1e3 * decision.now.peaks[i]
    least, most = quantile_band(widths, BAND).tolist()
    risk = float((widths > forecast.goal.tolerance_nm).mean())
    numbers = replace(told.numbers, median=float(np.median(widths)), least=least, most=most, exceeds=risk)
    return replace(told, numbers=numbers, risk=risk)


def _budget(found: Identification, goal: Goal) -> tuple[Budget | None, str]:
    estimate = found.estimate
    if not estimate.trust.usable:
        return None, estimate.trust.against
    try:
        driven = find_task(estimate.cell, estimate.vector(), goal.tasks[0], radius=goal.radius_um).driven()
        return budget_of(estimate, driven), ""
    except InputError as error:
        return None, str(error)
