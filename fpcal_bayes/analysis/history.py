"""The history of a campaign: parameters and the error of the tasks on a grid of times, and what each session told."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fpcal_bayes.analysis.campaign import CampaignFacts
from fpcal_bayes.core.linalg import chi2_tail, covariance_root
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.decision.forecast import Forecaster
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.tracking.filter import predict
from fpcal_bayes.tracking.measurement import SweepMeasurement
from fpcal_bayes.tracking.session import SessionOutcome
from fpcal_bayes.tracking.tracker import Track, smooth_track

#: Times of the grid at most, and at least so many between two sessions.
_MOST_TIMES, _LEAST_BETWEEN, _LEAST_AHEAD = 480, 3, 24
#: Times at which the error of the tasks is worked out, at most.
_MOST_OUTLOOKS = 160
#: Changes rarer than this the drift does not explain; least share of a direction's variance that was told; draws.
_EXPLAINED, _TOLD, _DRAWS = 1e-3, 1e-2, 1000


@dataclass(frozen=True)
class History:
    """Parameters through time, in the units a person reads."""

    hours: Floats  # (t,); the time of a session stands twice, before and after it
    mean: Floats  # (t, n), filtered
    sd: Floats  # (t, n)
    smooth_hours: Floats  # (s,), the sessions
    smooth_mean: Floats  # (s, n), given all of them
    truth: Floats | None  # (t, n), what a simulation was made from, NaN where unknown
    #: Session, hours and verdict of each session that was not as modelled.
    alarms: tuple[tuple[str, float, str], ...]


@dataclass(frozen=True)
class TaskForecasts:
    """Error of the worst task that must be held, while the estimate of the last session is used; each (t,)."""

    hours: Floats
    median: Floats  # peak to peak, um
    low: Floats  # edges of its 95 % band
    high: Floats
    risk: Floats  # probability of being out of tolerance


@dataclass(frozen=True)
class SessionResiduals:
    """What the estimate after a session leaves of its n rows."""

    session: str
    labels: tuple[str, ...]
    values: Floats  # (n,), measured less expected over the stated standard deviation


@dataclass(frozen=True)
class TaskChange:
    """By how much a task is off if it is still driven with the calibration, peak to peak, in nm."""

    name: str
    change: float  # by the last estimate
    # median and 97.5 % quantile of what the stated drift lets expect of it
    expected: float
    most: float


@dataclass(frozen=True)
class SinceCalibration:
    """What changed between last calibration and last session, held against the stated drift: a normal change."""

    session: str  # the calibration
    hours: float  # from it to the last session
    parameters: ParameterSet
    change: Floats  # of the parameters, (n,), in the units a person reads
    sd: Floats  # of that change, by drift and all that was not known; NaN where nothing new was told
    chi2: float  # of the change in all directions of which the sessions told something, and how many these are
    dof: int
    tasks: tuple[TaskChange, ...]

    @property
    def p_value(self) -> float:
        """Probability of a change as large or larger under the stated drift."""
        return chi2_tail(self.chi2, self.dof)

    @property
    def explained(self) -> bool:
        """Whether the stated drift explains the change."""
        return self.p_value >= _EXPLAINED


def since_calibration(facts: CampaignFacts) -> SinceCalibration | None:
    """The last session against the last calibration before it, or None where there are no two to compare."""
    followed = facts.track
    if followed is None or facts.fit_is_wrong or len(followed.outcomes) < 2:
        return None
    last, n = followed.last, followed.drift.n_lengths
    reference = [o for o in followed.outcomes[1:-1] if o.dof >= len(followed.drift.parameters)]
    before = (reference or [followed.outcomes[0]])[-1]
    stated = replace(followed.drift, pace=(1.0, 1.0))
    ahead = predict(stated, before.state, last.time_h, last.state.temperature_c)
    moved = (last.state.mean - ahead.mean)[:n]
    told = (ahead.covariance - last.state.covariance)[:n, :n]
    white = np.linalg.pinv(covariance_root(ahead.covariance[:n, :n]))
    shares, axes = np.linalg.eigh(white @ told @ white.T)
    seen = shares > _TOLD
    scores = (axes.T @ white @ moved)[seen] / np.sqrt(shares[seen])
    drift, parameters = followed.drift, followed.drift.parameters
    scale, m = drift.scale / parameters.scales, len(parameters)
    variance = np.diag(told)[:m]
    new = variance > _TOLD * np.diag(ahead.covariance)[:m]
    model, names = CavityModel.of(followed.cell, parameters), tuple(t.name for t in facts.tasks if t.task is not None)
    tasks: list[TaskChange] = []
    if names:
        held = Forecaster.of(stated, model, replace(facts.goal, tasks=names), before.state.mean)
        spread = covariance_root(told) @ np.random.default_rng(0).standard_normal((n, _DRAWS))
        for name, points, count in zip(names, held.tasks, held.counts, strict=True):
            # The first of its degrees of freedom is the one along the beam.
            rows = np.split(held.jacobian[points], count)[0]
            middle, most = 1e3 * np.quantile(np.ptp(rows @ spread, axis=0), [0.5, 0.975])
            tasks.append(TaskChange(name, 1e3 * float(np.ptp(rows @ moved)), float(middle), float(most)))
    return SinceCalibration(
        session=before.session,
        hours=last.time_h - before.time_h,
        parameters=parameters,
        change=moved[:m] * scale,
        sd=np.where(new, np.sqrt(np.clip(variance, 0.0, None)), np.nan) * scale,
        chi2=float(scores @ scores),
        dof=int(seen.sum()),
        tasks=tuple(tasks),
    )


def history(facts: CampaignFacts) -> History | None:
    """Parameters through time, or None where the sessions cannot be followed."""
    followed = facts.track
    if followed is None:
        return None
    drift, parameters = followed.drift, followed.drift.parameters
    hours, after = _grid(followed, facts.now_h + facts.costs.horizon_h, _MOST_TIMES)
    states = [predict(drift, followed.outcomes[i].state, float(h)) for h, i in zip(hours, after, strict=True)]
    n = drift.n_parameters
    smoothed = smooth_track(followed, facts.sweeps).states
    return History(
        hours=hours,
        mean=np.array([parameters.to_shown(drift.values(state.mean)) for state in states]),
        sd=np.array([np.sqrt(np.diag(state.covariance)[:n]) * drift.scale / parameters.scales for state in states]),
        smooth_hours=np.array([state.time_h for state in smoothed]),
        smooth_mean=np.array([parameters.to_shown(drift.values(state.mean)) for state in smoothed]),
        truth=_truth(facts, hours, parameters.names),
        alarms=tuple((o.session, o.time_h, o.verdict) for o in followed.outcomes if o.verdict != "as-modelled"),
    )


def outlooks(facts: CampaignFacts) -> TaskForecasts | None:
    """Error of the tasks through time, or None where there is no forecast."""
    followed, forecast = facts.track, facts.forecast
    if followed is None or forecast is None or facts.fit_is_wrong:
        return None
    hours, after = _grid(followed, facts.now_h + facts.costs.horizon_h, _MOST_OUTLOOKS)
    rows = []
    for time_h, number in zip(hours, after, strict=True):
        state = followed.outcomes[number].state
        held = forecast.following(state.mean)
        found = held.outlook(held.ahead(state, float(time_h) - state.time_h))
        rows.append((found.median, *found.band(), found.exceeds(facts.goal.tolerance_um)))
    median, low, high, risk = np.array(rows).T
    return TaskForecasts(hours, median, low, high, risk)


def residuals(facts: CampaignFacts) -> list[SessionResiduals]:
    """Residuals of every session that is followed; of the first one alone where nothing is."""
    followed = facts.track
    if followed is None:
        found = facts.calibration
        sweeps, parameters = found.problem.sweeps, found.estimate.parameters
        model = CavityModel.of(facts.cell, parameters, found.estimate.vector())
        return [_residuals(sweeps, model.predict(found.estimate.values, sweeps.laid_out(model)), sweeps.sigma)]
    model = CavityModel.of(facts.cell, followed.drift.parameters)
    parts = []
    for outcome in followed.outcomes:
        sweeps = facts.sweeps.of_session(outcome.session)
        used = sweeps.take(sweeps.kind != "path")
        if len(used):
            # Of a machine: beside the error motions that are known, and what is new in each row.
            taken = SweepMeasurement.of(followed.drift, model, used, outcome.state.mean)
            parts.append(_residuals(used, taken.predict(outcome.state.mean), np.sqrt(taken.whitening.variance)))
    return parts


def _residuals(sweeps: Sweeps, expected: Floats, sd: Floats) -> SessionResiduals:
    # Without a sign only the size is known: it is taken with the sign that is expected.
    measured = np.where(sweeps.signed | sweeps.absolute, sweeps.dl, np.sign(expected) * np.abs(sweeps.dl))
    labels = tuple(str(label) or f"row {row}" for label, row in zip(sweeps.label, sweeps.rows, strict=True))
    return SessionResiduals(str(sweeps.session[0]), labels, (measured - expected) / sd)


def _grid(followed: Track, end_h: float, most: int) -> tuple[Floats, Ints]:
    """Times from the calibration to `end_h`, and the last session at each."""
    times = np.array([outcome.time_h for outcome in followed.outcomes])
    counts = np.full(len(times), max(_LEAST_BETWEEN, most // len(times)))
    # What is to come is looked at closely.
    counts[-1] = max(counts[-1], _LEAST_AHEAD)
    ends = np.append(times[1:], max(end_h, times[-1]))
    hours = [np.linspace(begin, end, n) for begin, end, n in zip(times, ends, counts, strict=True)]
    return np.concatenate(hours), np.repeat(np.arange(len(times)), counts)


def _truth(facts: CampaignFacts, hours: Floats, names: tuple[str, ...]) -> Floats | None:
    if facts.campaign is None or facts.campaign.truth is None:
        return None
    truth = Truth.of_record(facts.campaign.truth, facts.cell)
    # Nothing is known after the last epoch, though the record itself stays constant there.
    known = truth.parameters.to_shown(truth.at(hours))
    known[hours > max(truth.times_h[-1], facts.now_h)] = np.nan
    result = np.full((len(hours), len(names)), np.nan)
    for i, name in enumerate(names):
        if name in truth.parameters:
            result[:, i] = known[:, truth.parameters.position(name)]
    return result


def session_bounds(outcome: SessionOutcome) -> tuple[float, float] | None:
    """95 % bounds of the innovation of a session, or None where no rows of it are tested."""
    if not outcome.dof:
        return None
    low, high = special.chdtri(outcome.dof, [0.975, 0.025]).tolist()
    return low, high


def session_log(facts: CampaignFacts) -> list[tuple[SessionOutcome, float, bool, float]] | None:
    """Each session, hours that its estimate held, or at least held, and how late the next one, or the present, came."""
    if facts.track is None or facts.forecast is None or facts.fit_is_wrong:
        return None
    entries, outcomes = [], facts.track.outcomes
    for outcome, until_h in zip(outcomes, [*(o.time_h for o in outcomes[1:]), facts.now_h], strict=True):
        gap = until_h - outcome.time_h
        horizon = max(gap, facts.costs.horizon_h)
        held = facts.forecast.following(outcome.state.mean).hold_hours(outcome.state, horizon)
        entries.append((outcome, held, held >= horizon, gap - held))
    return entries
