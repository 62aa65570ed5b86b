"""A track as a table and sentences for the terminal."""

from datetime import timedelta

from rich.markup import escape
from rich.table import Table

from fpcal_bayes.report.tables import plain_table
from fpcal_bayes.times import clock
from fpcal_bayes.track.step import SessionOutcome
from fpcal_bayes.track.tracker import Track, innovation_bounds

VERDICT_STYLES = {"as-modelled": "green", "extrinsics-moved": "yellow", "intrinsics-moved": "red"}


def time_text(time_h: float, outcomes: tuple[SessionOutcome, ...]) -> str:
    """A time as clock time where the sessions carry one, else in hours since the campaign began."""
    for outcome in reversed(outcomes):
        if outcome.utc:
            return f"{clock(outcome.utc) + timedelta(hours=time_h - outcome.time_h):%Y-%m-%d %H:%M %Z}".strip()
    return f"{time_h:.2f} h"


def session_table(track: Track, title: str) -> Table:
    """One line a session: when, how many sweeps, innovation with its 95 % bounds, verdict."""
    table = plain_table(title, ["session", "verdict", "time", "sweeps", "innovation", "95 % bounds"])
    for i, outcome in enumerate(track.outcomes):
        style = VERDICT_STYLES[outcome.verdict]
        if i == 0:
            verdict, bounds = "calibration", ""
        else:
            verdict = f"[{style}]{outcome.verdict}[/{style}]"
            bounds = "{:.1f} .. {:.1f}".format(*innovation_bounds(outcome.dof)) if outcome.dof else ""
        table.add_row(
            escape(outcome.session),
            verdict,
            time_text(outcome.time_h, track.outcomes),
            str(outcome.n_sweeps),
            f"{outcome.nis:.1f}" if outcome.dof else "",
            bounds,
        )
    return table


def verdict_lines(track: Track) -> list[str]:
    """What was found, a sentence a session that was not as modelled, and what follows."""
    lines = [
        f"{outcome.session}: {outcome.verdict}: {outcome.evidence[0]}"
        for outcome in track.outcomes
        if outcome.verdict != "as-modelled" and outcome.evidence
    ]
    if track.calibration_due is not None:
        lines.append(f"a full calibration is due: the robot itself moved before session {track.calibration_due}")
    return lines
