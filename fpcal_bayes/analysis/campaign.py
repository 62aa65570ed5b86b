"""What a report says about a campaign, worked out before anything is drawn."""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.decision import Costs, Decision
from fpcal_bayes.decision.forecast import Forecast, Goal
from fpcal_bayes.decision.policy import decide_track
from fpcal_bayes.infer.fit.goodness import chi2_tail
from fpcal_bayes.infer.fit.identify import POOR_FIT_BELOW
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.infer.observability.observe import Observability, observe
from fpcal_bayes.infer.posterior.netcdf import PosteriorSummary, read_posterior_summary
from fpcal_bayes.infer.tasks.budget import Budget, budget_of
from fpcal_bayes.infer.tasks.prediction import TaskPrediction, predict_from_covariance
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.sweeps import is_campaign_file, read_sweeps
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.tasks import Task, find_task, possible_tasks
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import likely_drift
from fpcal_bayes.tracking.filter import State
from fpcal_bayes.tracking.record import resume
from fpcal_bayes.tracking.sessions import check_sessions, hours_now, hours_of
from fpcal_bayes.tracking.tracker import Track, estimate_of, track

if TYPE_CHECKING:
    from fpcal_bayes.tracking.drift import DriftModel

#: Of a posterior file: more tell no more.
_MOST_DRAWS = 2000


@dataclass(frozen=True)
class Followed:
    """A campaign as it was read and followed.

    Attributes
    ----------
    track, sweeps
        Up to the last session, and all its rows.
    now_h
        The time that the user gave, or None.
    notes
        Sentences about what was saved before.
    campaign
        The campaign file, or None if it is a CSV.
    """

    track: "Track"
    sweeps: "Sweeps"
    now_h: float | None
    notes: list[str]
    campaign: "Campaign | None"


def follow(options: argparse.Namespace, cell: Cell, *, anew: bool = False, posterior: str | None = None) -> Followed:
    """Follow the campaign that the options name, from where a saved track ends.

    Parameters
    ----------
    anew
        From its first session on instead.
    posterior
        File of draws to start from, as ``fpcal sample`` writes it; from the first session on too.
    """
    from fpcal_bayes.core.files import file_sha256
    from fpcal_bayes.io.campaign import read_campaign
    from fpcal_bayes.io.sweeps import is_campaign_file, read_sweeps
    from fpcal_bayes.tracking.alarms import Limits
    from fpcal_bayes.tracking.drift import likely_drift
    from fpcal_bayes.tracking.record import resume
    from fpcal_bayes.tracking.sessions import check_sessions, hours_of
    from fpcal_bayes.tracking.tracker import track

    campaign = read_campaign(options.campaign, cell) if is_campaign_file(options.campaign) else None
    sweeps = read_sweeps(options.campaign, cell) if campaign is None else campaign.sweeps
    drift, limits = likely_drift(cell, sweeps), Limits()
    now_h = None if options.now is None else hours_of(options.now, sweeps)
    parts = check_sessions(sweeps, now_h)
    notes: list[str] = []
    draws = None if posterior is None else _draws(posterior, cell, drift)
    known = None
    if campaign is not None and campaign.track is not None and not anew and draws is None:
        known, note = resume(campaign.track, cell, drift, limits, parts, options.campaign)
        notes += [note] if note else []
    warm_up(cell)
    found = track(cell, sweeps, drift=drift, limits=limits, known=known, draws=draws, now_h=now_h)
    data = {"file": Path(options.campaign).name, "sha256": file_sha256(Path(options.campaign))}
    utc = {"utc": found.last.utc} if found.last.utc else {}
    found = replace(found, data=data | {"session": found.last.session} | utc)
    return Followed(found, sweeps, now_h, notes, campaign)


def _draws(posterior: str, cell: Cell, drift: "DriftModel") -> Floats:
    """The draws of the parameters that are followed, shape (n_draws, n_parameters)."""
    from fpcal_bayes.infer.posterior.netcdf import read_posterior

    read = read_posterior(posterior, cell)
    missing = [name for name in drift.parameters.names if name not in read.parameters]
    if missing:
        raise InputError(f"{posterior}: expected draws of all free parameters, {missing[0]} is missing")
    drawn = read.thinned(_MOST_DRAWS)
    if len(drawn.values) <= len(drift.parameters):
        raise InputError(f"{posterior}: {len(drawn.values)} draws, expected more than parameters")
    return drawn.values[:, drawn.parameters.positions(drift.parameters.names)]


#: Points along each task, and errors that are drawn of it.
_POINTS, _DRAWS = 61, 4000
#: Longest time between two sessions that can show a change of the robot itself, as `fpcal decide` has it.
_DIAGNOSIS_H = 24.0


@dataclass(frozen=True)
class TaskOutlook:
    """What is expected of one task now.

    Attributes
    ----------
    name, asked
        The task, and whether the cell must hold it.
    task, prediction
        Its path and its error, or None where it cannot be driven.
    reason
        Why it cannot, else empty.
    """

    name: str
    asked: bool
    task: Task | None
    prediction: TaskPrediction | None
    reason: str = ""


@dataclass(frozen=True)
class CampaignFacts:
    """Everything that a report shows.

    Attributes
    ----------
    file, sha256
        Name of the campaign file, without its folder, and hash of its bytes.
    cell, sweeps
        As read.
    campaign
        What the file holds beside the sweeps, or None if it is a CSV.
    goal, costs
        What the cell must hold, and what measuring costs.
    now_h
        Time that the report is for, in hours since the campaign began.
    observability
        Of the first session: the calibration.
    track, track_reason
        All sessions followed; or None, and why they cannot be.
    forecast
        Of the last estimate, or None where tasks cannot be judged.
    decision, decision_reason
        What to do now; or None, and why that cannot be said.
    estimate
        What the controller holds, with the covariance of the truth now.
    tasks
        One of each task.
    budget, budget_reason
        Of the first task that must be held, after the calibration; or None, and why there is none.
    posterior
        Of the calibration, or None if no draws were given.
    command
        The command line that made the report.
    """

    file: str
    sha256: str
    cell: Cell
    sweeps: Sweeps
    campaign: Campaign | None
    goal: Goal
    costs: Costs
    now_h: float
    observability: Observability
    track: Track | None
    track_reason: str
    forecast: Forecast | None
    decision: Decision | None
    decision_reason: str
    estimate: Estimate
    tasks: tuple[TaskOutlook, ...]
    budget: Budget | None
    budget_reason: str
    posterior: PosteriorSummary | None
    command: str

    @property
    def unusable(self) -> str:
        """Why nothing on the page is to be used: a fit that failed or that the noise does not explain; else empty."""
        found = self.observability.identification
        assert found is not None
        if not found.converged or (self.track is not None and not self.track.converged):
            return "the fit did not converge"
        fit = found.fit
        # Slipped counts that the track has corrected spoil nothing.
        mended = (
            self.track is not None
            and chi2_tail(self.track.outcomes[0].nis, self.track.outcomes[0].dof) > POOR_FIT_BELOW
        )
        if fit.p_value < POOR_FIT_BELOW and not mended:
            return (
                f"the calibration does not fit: chi-square of the data {fit.chi2_data:.1f}, expected {fit.expected:.1f}"
            )
        return ""


def gather(
    file: str | Path,
    cell: Cell,
    *,
    goal: Goal | None = None,
    now: str | None = None,
    posterior: str | Path | None = None,
    command: str = "",
) -> CampaignFacts:
    """Read a campaign and work out all that its report says.

    Parameters
    ----------
    file
        Campaign (HDF5) or CSV of measured sweeps; its first session calibrates.
    cell
        The cell that was measured.
    goal
        What must be held; by default a circle of 100 um radius within 50 nm.
    now
        Hours since the campaign began, or a clock time; by default this machine's clock where rows carry clock times,
        else the last session.
    posterior
        Draws of the calibration's posterior (.nc), or None.
    command
        For the provenance.

    Raises
    ------
    InputError
        If a file cannot be used, sessions overlap or repeat, or a task that must be held is unknown.
    """
    goal = Goal(0.05) if goal is None else goal
    path = Path(file)
    campaign = read_campaign(path, cell) if is_campaign_file(path) else None
    sweeps = read_sweeps(path, cell) if campaign is None else campaign.sweeps
    given_h = None if now is None else hours_of(now, sweeps)
    parts = check_sessions(sweeps, given_h)
    draws = None if posterior is None else read_posterior_summary(posterior, cell)
    observability = observe(cell, parts[0])
    followed, track_reason = _follow(path, cell, sweeps, parts, campaign, given_h)
    last_h = float(parts[-1].time_h.max())
    now_h = hours_now(sweeps, last_h) if given_h is None else given_h
    if now_h < last_h:
        raise InputError(f"{path}: now is {now_h:g} h, before the last session at {last_h:g} h: expected a time after")
    costs = Costs(sigma=float(np.median(sweeps.sigma)), diagnosis_h=_DIAGNOSIS_H)
    forecast, decision, decision_reason = _decide(followed, sweeps, goal, costs, now_h)
    estimate = _estimate_now(cell, observability, followed, now_h)
    tasks = tuple(_outlook(estimate, name, name in goal.tasks, goal) for name in _judged(goal, cell))
    budget, budget_reason = _budget(observability, goal)
    return CampaignFacts(
        file=path.name,
        sha256=file_sha256(path),
        cell=cell,
        sweeps=sweeps,
        campaign=campaign,
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
        tasks=tasks,
        budget=budget,
        budget_reason=budget_reason,
        posterior=draws,
        command=command,
    )


def state_at(followed: Track, forecast: Forecast, number: int, time_h: float) -> State:
    """What is known at a time after session `number`, from 0, if nothing is measured in between."""
    state = followed.outcomes[number].state
    return forecast.ahead(state, time_h - state.time_h)


def _judged(goal: Goal, cell: Cell) -> list[str]:
    """Tasks of the report: those to be held, then the others."""
    return [*goal.tasks, *(name for name in possible_tasks(cell) if name not in goal.tasks)]


def _follow(
    path: Path, cell: Cell, sweeps: Sweeps, parts: list[Sweeps], campaign: Campaign | None, now_h: float | None
) -> tuple[Track | None, str]:
    """All sessions followed, from where a saved track ends; or None, and why they cannot be."""
    limits = Limits()
    try:
        drift = likely_drift(cell, sweeps)
        known = None
        if campaign is not None and campaign.track is not None:
            known, _ = resume(campaign.track, cell, drift, limits, parts, str(path))
        found = track(cell, sweeps, drift=drift, limits=limits, known=known, now_h=now_h)
    except InputError as error:
        return None, str(error)
    data = {"file": path.name, "sha256": file_sha256(path), "session": found.last.session}
    return replace(found, data=data), ""


def _decide(
    followed: Track | None, sweeps: Sweeps, goal: Goal, costs: Costs, now_h: float
) -> tuple[Forecast | None, Decision | None, str]:
    """The forecast of the last estimate and the decision, or None for what cannot be had, and why."""
    if followed is None:
        return None, None, "the sessions cannot be followed, so that nothing is known about drift"
    model = CavityModel.of(followed.cell, followed.drift.parameters)
    try:
        forecast = Forecast.of(followed.drift, model, goal, followed.last.state.mean)
    except InputError as error:
        return None, None, str(error)
    try:
        return forecast, decide_track(followed, sweeps, goal, costs, now_h), ""
    except InputError as error:
        return forecast, None, str(error)


def _estimate_now(cell: Cell, observability: Observability, followed: Track | None, now_h: float) -> Estimate:
    """What the controller holds, with the covariance that the truth has around it now."""
    if followed is None:
        found = observability.identification
        # Sessions are measured, so that the first one was identified.
        assert found is not None
        return found.estimate
    state, drift = followed.last.state, followed.drift
    step = drift.transition(now_h - state.time_h)
    grown = replace(
        state,
        time_h=now_h,
        covariance=step.matrix @ state.covariance @ step.matrix.T + step.noise,
    )
    return estimate_of(cell, drift, grown, followed.status, followed.data)


def _outlook(estimate: Estimate, name: str, asked: bool, goal: Goal) -> TaskOutlook:
    try:
        task = find_task(estimate.cell, estimate.vector(), name, radius=goal.radius, n_points=_POINTS)
        driven = task.driven()
        return TaskOutlook(name, asked, task, predict_from_covariance(estimate, driven, draws=_DRAWS))
    except InputError as error:
        return TaskOutlook(name, asked, None, None, str(error))


def _budget(observability: Observability, goal: Goal) -> tuple[Budget | None, str]:
    """The budget of the first task after the calibration, from the sweeps that it was made from where that can be."""
    found = observability.identification
    assert found is not None
    try:
        driven = find_task(found.estimate.cell, found.estimate.vector(), goal.tasks[0], radius=goal.radius).driven()
        try:
            return budget_of(found.estimate, driven, sweeps=found.problem.sweeps), ""
        except InputError:
            # Signs that were decided with the fit: the inputs cannot be told apart.
            return budget_of(found.estimate, driven), ""
    except InputError as error:
        return None, str(error)
