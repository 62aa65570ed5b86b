"""Numbers for the charts of a report that can be zoomed, as plain lists."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.report.campaign_facts import CampaignFacts
from fpcal_bayes.report.campaign_history import History, Outlooks, SessionResiduals

Floats = NDArray[np.float64]

#: Rows of the residual chart at most: the latest ones.
_MOST_ROWS = 5000
#: Digits that are shown.
_DIGITS = 6


def track_chart(facts: CampaignFacts, found: History) -> dict[str, Any]:
    """Each parameter through time: filter with band, sessions alone, truth, alarms."""
    assert facts.track is not None
    hours = _increasing(found.hours)
    at = [_after(found, time_h) for _, time_h, _ in found.stored]
    alarms = [_after(found, time_h) for _, time_h, _ in found.alarms]
    parameters = []
    for i, parameter in enumerate(facts.track.drift.parameters):
        mean, sd = found.mean[:, i], found.sd[:, i]
        alone = np.full(len(hours), np.nan)
        for place, (_, _, values) in zip(at, found.stored, strict=True):
            if parameter.name in values:
                alone[place] = values[parameter.name][0]
        marked = np.full(len(hours), np.nan)
        marked[alarms] = mean[alarms]
        series = {
            "filter": mean,
            "low": mean - 2 * sd,
            "high": mean + 2 * sd,
            "session alone": alone,
            "alarm": marked,
        }
        if found.truth is not None:
            series["truth"] = found.truth[:, i]
        parameters.append(
            {
                "name": f"{parameter.name} [{parameter.unit}]",
                "series": {name: _numbers(values) for name, values in series.items() if np.isfinite(values).any()},
            }
        )
    return {"hours": _numbers(hours, 9), "now": facts.now_h, "parameters": parameters}


def outlook_chart(facts: CampaignFacts, found: Outlooks) -> dict[str, Any]:
    """The error of the worst task through time, in nm."""
    series = {"median": found.median, "low": found.low, "high": found.high}
    return {
        "hours": _numbers(_increasing(found.hours), 9),
        "now": facts.now_h,
        "tolerance": 1e3 * facts.goal.tolerance,
        "series": {name: _numbers(1e3 * values) for name, values in series.items()},
        "risk": _numbers(found.risk, 4),
    }


def residual_chart(parts: list[SessionResiduals]) -> dict[str, Any]:
    """Residuals of the rows of all sessions, one after the other, with their names."""
    names = [f"{part.session}: {label}" for part in parts for label in part.labels][-_MOST_ROWS:]
    values = np.concatenate([part.values for part in parts])[-_MOST_ROWS:]
    return {"names": names, "values": _numbers(values, 4)}


def _increasing(hours: Floats) -> Floats:
    """The times with ties apart by a second, as a chart wants them."""
    apart = hours.copy()
    for i in range(1, len(apart)):
        apart[i] = max(apart[i], apart[i - 1] + 1.0 / 3600.0)
    return apart


def _numbers(values: Iterable[float], digits: int = _DIGITS) -> list[float | None]:
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values]


def _after(found: History, time_h: float) -> int:
    """Position on the grid just after a session."""
    return max(0, int(np.searchsorted(found.hours, time_h, side="right")) - 1)
