"""A track and a decision as sentences, as tables and as JSON."""

from datetime import timedelta
from typing import Any

from fpcal_bayes.analysis.history import session_bounds
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.times import clock
from fpcal_bayes.decision.decision import Decision
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.plan import sweeps_table
from fpcal_bayes.report.table import Table, plain_table
from fpcal_bayes.report.table import TableCell as Entry
from fpcal_bayes.tracking.alarms import ROBOT_MOVED
from fpcal_bayes.tracking.session import SessionOutcome
from fpcal_bayes.tracking.tracker import Track

#: How good the verdict of a session is.
VERDICT_STYLES = {"as-modelled": "good", "extrinsics-moved": "caution", **dict.fromkeys(ROBOT_MOVED, "bad")}


def time_text(time_h: float, outcomes: tuple[SessionOutcome, ...]) -> str:
    """A time as clock time where the sessions carry one, else in hours since the campaign began."""
    for outcome in reversed(outcomes):
        if outcome.utc:
            return f"{clock(outcome.utc) + timedelta(hours=time_h - outcome.time_h):%Y-%m-%d %H:%M %Z}".strip()
    return f"{time_h:.2f} h"


def session_table(track: Track, title: str) -> Table:
    """One line per session: when, how many sweeps, innovation with its 95 % bounds, verdict."""
    table = plain_table(title, ["session", "verdict", "time", "sweeps", "innovation", "95 % bounds"])
    for i, outcome in enumerate(track.outcomes):
        bounds = session_bounds(outcome) if i else None
        table.add_row(
            outcome.session,
            Entry(outcome.verdict, style=VERDICT_STYLES[outcome.verdict]) if i else "calibration",
            time_text(outcome.time_h, track.outcomes),
            str(outcome.n_sweeps),
            f"{outcome.nis:.1f}" if outcome.dof else "",
            "" if bounds is None else f"{bounds[0]:.1f} .. {bounds[1]:.1f}",
        )
    return table


def verdict_lines(track: Track) -> list[str]:
    """One sentence per session that was not as modelled, and what follows."""
    lines = [
        f"{outcome.session}: {outcome.verdict}: {outcome.evidence[0]}"
        for outcome in track.outcomes
        if outcome.verdict != "as-modelled" and outcome.evidence
    ]
    known = track.outcomes[0].trust.reasons
    lines += [r.text for r in track.trust.reasons if r.kind == "not-converged" and r not in known]
    if track.calibration_due is not None:
        lines.append(f"a full calibration is due: the robot itself moved before session {track.calibration_due}")
    return lines


def decision_sentence(decision: Decision, track: Track) -> str:
    """What to do, in one sentence."""
    if not track.trust.usable and track.calibration_due is None:
        doctor = "" if "fpcal doctor" in track.trust.against else "; fpcal doctor says what is wrong"
        return f"do not use this estimate: {track.trust.against}{doctor}"
    if decision.action == "hold" and decision.attainable_nm is not None:
        return f"measure nothing: {decision.reason}"
    if decision.action == "hold":
        until = time_text(decision.now_h + decision.hold_hours, track.outcomes)
        return f"hold until {until} ({decision.hold_hours:.1f} h from now): {decision.reason}"
    count = 0 if decision.sweeps is None else len(decision.sweeps)
    cost = f"about {decision.minutes:.0f} min"
    full = f"full calibration now ({counted(count, 'sweep')}, {cost}): {decision.reason}"
    risk, hours = f"beyond the tolerance with more than {100 * decision.level:g} %", decision.then_hours
    holds = f"good for {hours:.1f} h" if hours >= LEAST_HOURS else f"after these alone {risk}"
    after = f"expected error after: {1e3 * decision.after.median:.1f} nm, {holds}"
    if not track.trust.usable:
        return full
    if decision.action == "full":
        return f"{full}; {after}"
    these = "this sweep" if count == 1 else f"these {count} sweeps"
    return f"{_PURPOSES[decision.purpose]} now with {these} ({cost}): {decision.reason}; {after}"


#: What holds for less is said not to hold.
LEAST_HOURS = 0.05
#: What sweeps other than a full calibration are for.
_PURPOSES = {
    "extrinsics": "re-identify extrinsics",
    "robot": "look at the robot",
    "both": "re-identify extrinsics and look at the robot",
}


def outlook_table(decision: Decision, goal: Goal, track: Track) -> Table:
    """Peak to peak of the worst task now, after what is recommended, and at the horizon if nothing is measured."""
    heads = ["when", "time", "median [nm]", "95 % band [nm]", f"P(> {1e3 * goal.tolerance_um:g} nm)"]
    title = f"peak to peak of the worst of: {', '.join(goal.tasks)}"
    others = [
        f"{name} {' '.join(f'{key} {limit:g}' for key, limit in held.items())}"
        for name, held in _other_tolerances(goal, track.cell).items()
    ]
    table = plain_table(f"{title}; as a share of the tolerance also {', '.join(others)}" if others else title, heads)
    for name, outlook in (
        ("now", decision.now),
        ("at the end of the hold" if decision.action == "hold" else "after these sweeps", decision.after),
        ("at the horizon, nothing measured", decision.at_horizon),
    ):
        low, high = outlook.band()
        numbers = [f"{1e3 * outlook.median:.1f}", f"{1e3 * low:.1f} .. {1e3 * high:.1f}"]
        numbers.append(f"{outlook.exceeds(goal.tolerance_um):.3f}")
        shown = numbers if track.trust.usable else ["not to be used", "", ""]
        table.add_row(name, time_text(outlook.time_h, track.outcomes), *shown)
    return table


def _other_tolerances(goal: Goal, cell: Cell) -> dict[str, dict[str, float]]:
    """What tasks of the cell's own are held to beside the cavity length, in nm and deg, by task."""
    stated = {task.name: task.stated for task in cell.tasks if task.name in goal.tasks}
    found = {name: {key: limit for key, limit in held.items() if key != "beam_nm"} for name, held in stated.items()}
    return {name: held for name, held in found.items() if held}


def sweep_table(sweeps: Sweeps, cell: Cell) -> Table:
    """One line per sweep, the most useful first."""
    return sweeps_table(cell, sweeps, "sweeps, the most useful first", [str(i) for i in range(1, len(sweeps) + 1)])


def decision_content(decision: Decision, goal: Goal, track: Track) -> dict[str, Any]:
    """A decision as JSON: medians of the worst peak to peak in nm, chances; null where the track is not to be used."""
    outlooks = {"now": decision.now, "at_horizon": decision.at_horizon, "after": decision.after}
    usable = track.trust.usable
    return {
        "action": decision.action,
        "purpose": None if decision.action == "hold" else "full" if decision.action == "full" else decision.purpose,
        "sentence": decision_sentence(decision, track),
        "reason": decision.reason,
        "now_h": decision.now_h,
        "hold_hours": decision.hold_hours,
        "hold_until": time_text(decision.now_h + decision.hold_hours, track.outcomes),
        "then_hold_hours": decision.then_hours if usable else None,
        "minutes": decision.minutes,
        "level": decision.level,
        "tolerance_nm": 1e3 * goal.tolerance_um,
        "attainable_nm": decision.attainable_nm if usable else None,
        "tasks": list(goal.tasks),
        "other_tolerances": _other_tolerances(goal, track.cell),
        "sweeps": [] if decision.sweeps is None else sweeps_content(decision.sweeps, track.cell),
        "task_error_nm": {name: 1e3 * outlook.median if usable else None for name, outlook in outlooks.items()},
        "task_error_band_nm": {
            k: [1e3 * edge for edge in one.band()] if usable else None for k, one in outlooks.items()
        },
        "probability_out": {k: one.exceeds(goal.tolerance_um) if usable else None for k, one in outlooks.items()},
        "horizon_h": decision.at_horizon.time_h - decision.now_h,
    }


def sweeps_content(sweeps: Sweeps, cell: Cell) -> list[dict[str, Any]]:
    """Each sweep under the names of a CSV's columns."""
    columns = [column.split("_") for column in cell.joint_columns]
    found: list[dict[str, Any]] = []
    for i in range(len(sweeps)):
        entry: dict[str, Any] = {"label": str(sweeps.label[i])}
        for end, q in (("start", sweeps.q_start[i]), ("end", sweeps.q_end[i])):
            values = q / cell.joint_scales
            entry |= {f"{name}_{end}_{unit}": float(v) for (name, unit), v in zip(columns, values, strict=True)}
        found.append(entry)
    return found
