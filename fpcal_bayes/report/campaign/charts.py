"""What moves on the page of a campaign: the data of its charts, and the log of its sessions."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from fpcal_bayes.analysis.campaign import CampaignFacts
from fpcal_bayes.analysis.history import SessionResiduals, TaskForecasts, session_log
from fpcal_bayes.report.campaign.words import shown_time
from fpcal_bayes.report.table import Table, figure_of, plain_table
from fpcal_bayes.report.track import LEAST_HOURS

#: Rows of the residual chart at most: the latest ones.
_MOST_ROWS = 5000


def outlook_chart(facts: CampaignFacts, found: TaskForecasts) -> dict[str, Any]:
    """The error of the worst task through time, in nm."""
    # A chart wants ties apart, here by a second.
    seconds = np.arange(len(found.hours)) / 3600.0
    hours = np.maximum.accumulate(found.hours - seconds) + seconds
    limit = np.full(len(found.hours), facts.goal.tolerance_um)
    series = {"median": found.median, "low": found.low, "high": found.high, "tolerance": limit}
    return {
        "hours": _numbers(hours, 9),
        "now": facts.now_h,
        "series": {name: _numbers(1e3 * values) for name, values in series.items()},
    }


def residual_chart(parts: list[SessionResiduals]) -> dict[str, Any]:
    """Residuals of the rows of all sessions, one after the other, with their names."""
    names = [f"{part.session}: {label}" for part in parts for label in part.labels][-_MOST_ROWS:]
    return {"names": names, "values": _numbers(np.concatenate([part.values for part in parts])[-_MOST_ROWS:])}


def _numbers(values: Iterable[float], digits: int = 4) -> list[float | None]:
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values]


#: A session this much after the end of the hold still comes in time.
_SLACK_H = 0.1


def log_table(facts: CampaignFacts) -> Table | None:
    """One line per session: until when its estimate held, what the tests say; None where that cannot be judged."""
    log = session_log(facts)
    if log is None:
        return None
    heads = ["session", "time", "next session", "estimate good for", "evidence and warnings"]
    table = plain_table("Log", heads, words=(0, 2, -1))
    for outcome, held, at_least, late in log:
        last = outcome is log[-1][0]
        if late <= _SLACK_H:
            follows = "latest" if last else "in time"
        else:
            follows = f"overdue by {late:.1f} h" if last else f"{late:.1f} h late"
        good = f"{'at least ' * at_least}{held:.1f} h" if held >= LEAST_HOURS else "at risk from the start"
        table.add_row(
            outcome.session,
            figure_of(outcome.time_h, shown_time(outcome.time_h, facts)),
            figure_of(late, follows, "good" if late <= _SLACK_H else "caution"),
            figure_of(held, good),
            "; ".join((*outcome.evidence, *outcome.warnings)) or "nothing to report",
        )
    return table
