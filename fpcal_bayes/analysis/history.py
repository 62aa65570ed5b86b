"""The history of a campaign on a grid of times: parameters, the error of the tasks, residuals of every row."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.analysis.campaign import CampaignFacts, state_at
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.tracker import Track, smooth_track

#: Times of the grid at most, and at least so many between two sessions.
_MOST_TIMES, _LEAST_BETWEEN, _LEAST_AHEAD = 480, 3, 24
#: Times at which the error of the tasks is worked out, at most.
_MOST_OUTLOOKS = 160


@dataclass(frozen=True)
class History:
    """Parameters and errors of the tasks through time.

    Attributes
    ----------
    hours
        Grid of t times; the time of a session stands twice, before and after it.
    after
        Number of the last session at each time, shape (t,).
    mean, sd
        Filtered parameters in the units a person reads, shape (t, n).
    smooth_hours, smooth_mean, smooth_sd
        The same at the sessions, given all of them, shapes (s,), (s, n), (s, n).
    truth
        What a simulation was made from, shape (t, n), NaN where unknown; or None.
    stored
        Estimates that the file holds: session, hours, values and sds by name in the units a person reads.
    alarms
        Session, hours and verdict of each session that was not as modelled.
    """

    hours: Floats
    after: NDArray[np.int64]
    mean: Floats
    sd: Floats
    smooth_hours: Floats
    smooth_mean: Floats
    smooth_sd: Floats
    truth: Floats | None
    stored: tuple[tuple[str, float, dict[str, tuple[float, float]]], ...]
    alarms: tuple[tuple[str, float, str], ...]


@dataclass(frozen=True)
class Outlooks:
    """Error of the worst task that must be held, while the estimate of the last session is used.

    Attributes
    ----------
    hours
        Shape (t,).
    median, low, high
        Peak to peak in um and its 95 % band, shape (t,).
    risk
        Probability of being out of tolerance, shape (t,).
    """

    hours: Floats
    median: Floats
    low: Floats
    high: Floats
    risk: Floats


@dataclass(frozen=True)
class SessionResiduals:
    """What the estimate after a session leaves of its rows.

    Attributes
    ----------
    session, labels
        Names of the session and of its n rows.
    values
        Measured less expected, over the stated standard deviation, shape (n,).
    """

    session: str
    labels: tuple[str, ...]
    values: Floats


def history(facts: CampaignFacts) -> History | None:
    """Parameters through time, or None where the sessions cannot be followed."""
    followed = facts.track
    if followed is None:
        return None
    drift, parameters = followed.drift, followed.drift.parameters
    hours, after = _grid(followed, facts.now_h + facts.costs.horizon_h, _MOST_TIMES)
    states = []
    for time_h, number in zip(hours, after, strict=True):
        state = followed.outcomes[number].state
        mean, covariance = drift.propagate(state.mean, state.covariance, time_h - state.time_h)
        states.append((mean, np.diag(covariance)))
    scale = drift.scale / parameters.scales
    n = drift.n_parameters
    smoothed = smooth_track(followed, facts.sweeps).states
    return History(
        hours=hours,
        after=after,
        mean=np.array([parameters.to_shown(drift.values(mean)) for mean, _ in states]),
        sd=np.array([np.sqrt(variance[:n]) * scale for _, variance in states]),
        smooth_hours=np.array([state.time_h for state in smoothed]),
        smooth_mean=np.array([parameters.to_shown(drift.values(state.mean)) for state in smoothed]),
        smooth_sd=np.array([np.sqrt(np.diag(state.covariance)[:n]) * scale for state in smoothed]),
        truth=_truth(facts, hours, parameters.names),
        stored=_stored(facts),
        alarms=tuple((o.session, o.time_h, o.verdict) for o in followed.outcomes if o.verdict != "as-modelled"),
    )


def outlooks(facts: CampaignFacts) -> Outlooks | None:
    """Error of the tasks through time, or None where there is no forecast."""
    followed, forecast = facts.track, facts.forecast
    if followed is None or forecast is None:
        return None
    hours, after = _grid(followed, facts.now_h + facts.costs.horizon_h, _MOST_OUTLOOKS)
    rows = []
    for time_h, number in zip(hours, after, strict=True):
        held = forecast.following(followed.outcomes[number].state.mean)
        found = held.outlook(state_at(followed, held, int(number), float(time_h)))
        rows.append((found.median, *found.band(), found.exceeds(facts.goal.tolerance)))
    median, low, high, risk = np.array(rows).T
    return Outlooks(hours, median, low, high, risk)


def residuals(facts: CampaignFacts) -> list[SessionResiduals]:
    """Residuals of every session that is followed; of the first one alone where nothing is."""
    followed = facts.track
    if followed is None:
        found = facts.observability.identification
        assert found is not None
        return [_residuals(facts, found.problem.sweeps, found.estimate.vector())]
    model = CavityModel.of(facts.cell, followed.drift.parameters)
    parts = []
    for outcome in followed.outcomes:
        sweeps = facts.sweeps.of_session(outcome.session)
        used = sweeps.take(sweeps.kind != "path")
        if len(used):
            parts.append(_residuals(facts, used, model.vector(followed.drift.values(outcome.state.mean))))
    return parts


def _residuals(facts: CampaignFacts, sweeps: Sweeps, vector: Floats) -> SessionResiduals:
    model = CavityModel.of(facts.cell, facts.cell.free, vector)
    expected = model.predict(vector[facts.cell.free.slots], model.rows(sweeps.q_start, sweeps.q_end, sweeps.absolute))
    # Without a sign only the size is known: it is taken with the sign that is expected.
    measured = np.where(sweeps.signed | sweeps.absolute, sweeps.dl, np.sign(expected) * np.abs(sweeps.dl))
    labels = tuple(str(label) or f"row {row}" for label, row in zip(sweeps.label, sweeps.rows, strict=True))
    return SessionResiduals(str(sweeps.session[0]), labels, (measured - expected) / sweeps.sigma)


def _grid(followed: Track, end_h: float, most: int) -> tuple[Floats, NDArray[np.int64]]:
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


def _stored(facts: CampaignFacts) -> tuple[tuple[str, float, dict[str, tuple[float, float]]], ...]:
    """Estimates of the file that are of its sessions; entries that are not numbers are passed over."""
    if facts.campaign is None:
        return ()
    found = []
    for session, content in facts.campaign.estimates.items():
        if session not in facts.sweeps.sessions:
            continue
        stated = content.get("parameters")
        values = {}
        for name, entry in stated.items() if isinstance(stated, dict) else ():
            if not isinstance(entry, dict) or entry.get("status") == "fixed":
                continue
            value, sd = entry.get("value"), entry.get("sd")
            if isinstance(value, (int, float)) and isinstance(sd, (int, float)) and np.isfinite([value, sd]).all():
                values[str(name)] = (float(value), float(sd))
        time_h = float(facts.sweeps.of_session(session).time_h.max())
        found.append((session, time_h, values))
    return tuple(sorted(found, key=lambda entry: entry[1]))
