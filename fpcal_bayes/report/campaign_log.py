"""The log of a campaign's report: what was decided, what it gave, and how long each estimate held."""

from fpcal_bayes.report.campaign_facts import CampaignFacts
from fpcal_bayes.report.campaign_words import shown_time
from fpcal_bayes.report.page_table import Cell, PageTable, figure_of, table
from fpcal_bayes.track.record import decisions_of

#: A session this much after the end of the hold still comes in time.
_SLACK_H = 0.1
_DONE = {"hold": "held", "extrinsic": "re-identified", "full": "recalibrated"}


def log_table(facts: CampaignFacts) -> PageTable | None:
    """A line a session: the saved decision that led to it, until when its estimate held, and what the tests say.

    None where the sessions cannot be followed, or the tasks cannot be judged.
    """
    if facts.track is None or facts.forecast is None:
        return None
    decided = _decided(facts)
    rows, outcomes, forecast = [], facts.track.outcomes, facts.forecast
    for i, outcome in enumerate(outcomes):
        last = i + 1 == len(outcomes)
        until = facts.now_h if last else outcomes[i + 1].time_h
        horizon = max(until - outcome.time_h, facts.costs.horizon_h)
        held = forecast.following(outcome.state.mean).hold_hours(outcome.state, horizon)
        at_least = "at least " if held >= horizon else ""
        rows.append(
            [
                Cell(outcome.session),
                figure_of(outcome.time_h, shown_time(outcome.time_h, facts)),
                *([Cell(decided.get(outcome.session, ""))] if decided else []),
                figure_of(held, f"{at_least}{held:.1f} h"),
                _next(until - outcome.time_h - held, last=last),
                Cell("; ".join((*outcome.evidence, *outcome.warnings)) or "nothing to report"),
            ]
        )
    decision = ["decision before it"] if decided else []
    columns = ("session", "time", *decision, "estimate good for", "next session", "evidence and warnings")
    return table("Log", columns, rows, (0, *([2] if decided else []), len(columns) - 2, len(columns) - 1))


def _next(late: float, *, last: bool) -> Cell:
    """Whether the next session, or the present after the last one, comes before the hold has ended."""
    if late <= _SLACK_H:
        return Cell("latest" if last else "in time", f"{late:.6g}", "good")
    return Cell(f"overdue by {late:.1f} h" if last else f"{late:.1f} h late", f"{late:.6g}", "caution")


def _decided(facts: CampaignFacts) -> dict[str, str]:
    """The decisions that the file holds, in words, by the session that followed."""
    if facts.campaign is None or facts.campaign.track is None:
        return {}
    found = {}
    for entry in decisions_of(facts.campaign.track):
        action, reason = str(entry.get("action", "")), str(entry.get("reason", ""))
        found[str(entry.get("session", ""))] = f"{_DONE.get(action, action)}: {reason}"
    return found
