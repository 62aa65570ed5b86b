"""What moves on the page of a campaign: the data of its charts, and the log of its sessions."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from fpcal_bayes.analysis.campaign import CampaignFacts
from fpcal_bayes.analysis.history import History, SessionResiduals, TaskForecasts, session_log
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.report.campaign.words import shown_time
from fpcal_bayes.report.table import Table, TableCell, figure_of, plain_table
from fpcal_bayes.report.track import LEAST_HOURS

#: Rows of the residual chart at most: the latest ones.
_MOST_ROWS = 5000
#: Digits that are shown.
_DIGITS = 6


def track_chart(facts: CampaignFacts, found: History) -> dict[str, Any]:
    """Each parameter through time: filter with band, truth, alarms."""
    assert facts.track is not None
    hours = _increasing(found.hours)
    # Positions on the grid just after the sessions.
    alarms = [max(0, int(np.searchsorted(found.hours, time_h, side="right")) - 1) for _, time_h, _ in found.alarms]
    parameters = []
    for i, parameter in enumerate(facts.track.drift.parameters):
        mean, sd = found.mean[:, i], found.sd[:, i]
        marked = np.full(len(hours), np.nan)
        marked[alarms] = mean[alarms]
        series = {"filter": mean, "low": mean - 2 * sd, "high": mean + 2 * sd, "alarm": marked}
        if found.truth is not None:
            series["truth"] = found.truth[:, i]
        shown = {name: _numbers(values) for name, values in series.items() if np.isfinite(values).any()}
        parameters.append({"name": f"{parameter.name} [{parameter.unit}]", "series": shown})
    return {"hours": _numbers(hours, 9), "now": facts.now_h, "parameters": parameters}


def outlook_chart(facts: CampaignFacts, found: TaskForecasts) -> dict[str, Any]:
    """The error of the worst task through time, in nm."""
    series = {"median": found.median, "low": found.low, "high": found.high}
    return {
        "hours": _numbers(_increasing(found.hours), 9),
        "now": facts.now_h,
        "tolerance": 1e3 * facts.goal.tolerance_um,
        "series": {name: _numbers(1e3 * values) for name, values in series.items()},
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


#: A session this much after the end of the hold still comes in time.
_SLACK_H = 0.1


def log_table(facts: CampaignFacts) -> Table | None:
    """One line per session: until when its estimate held, what the tests say; None where that cannot be judged."""
    log = session_log(facts)
    if log is None:
        return None
    heads = ["session", "time", "estimate good for", "next session", "evidence and warnings"]
    table = plain_table("Log", heads, words=(0, -2, -1))
    for outcome, held, at_least, late in log:
        good = f"{'at least ' * at_least}{held:.1f} h" if held >= LEAST_HOURS else "at risk from the start"
        table.add_row(
            outcome.session,
            figure_of(outcome.time_h, shown_time(outcome.time_h, facts)),
            figure_of(held, good),
            _next(late, last=outcome is log[-1][0]),
            "; ".join((*outcome.evidence, *outcome.warnings)) or "nothing to report",
        )
    return table


def _next(late: float, *, last: bool) -> TableCell:
    """Whether the next session, or the present after the last one, comes before the hold has ended."""
    if late <= _SLACK_H:
        return TableCell("latest" if last else "in time", f"{late:.6g}", "good")
    return TableCell(f"overdue by {late:.1f} h" if last else f"{late:.1f} h late", f"{late:.6g}", "caution")
