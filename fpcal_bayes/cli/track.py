"""``fpcal track``: follow the parameters of a cell from session to session."""

import argparse

from fpcal_bayes.analysis.keep import follow_saved, published
from fpcal_bayes.analysis.watch import watch
from fpcal_bayes.cli.common import show, warn, write_result
from fpcal_bayes.cli.driven import goal_of
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.decision.policy import valid_until
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.io.cell import write_resized_cell
from fpcal_bayes.io.flat import FLAT_SUFFIXES, write_flat
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.flat import flat_content
from fpcal_bayes.report.fit import parameter_table
from fpcal_bayes.report.track import session_table, time_text, verdict_lines
from fpcal_bayes.tracking.fit_sizes import fit_sizes
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.tracker import Track


def run(options: argparse.Namespace, cell: Cell) -> int:
    goal = goal_of(options, cell)
    if options.watch is None:
        return _take_in(options, cell, goal)
    status = 0

    def take_in(again: bool) -> None:
        nonlocal status
        status = _take_in(options, cell, goal, again=again)
        options.anew = False

    try:
        watch(options.campaign, options.watch, take_in, lambda text: warn([text]))
    except (KeyboardInterrupt, SystemExit):
        return status


def _take_in(options: argparse.Namespace, cell: Cell, goal: Goal, *, again: bool = False) -> int:
    """Take in what is new and write what is asked for; `again` is silent where nothing is new."""
    require_suffix(options.flat, *FLAT_SUFFIXES)
    if options.output is not None:
        if not options.fit_drift or options.output.suffix.lower() != ".toml":
            raise InputError("-o CELL.toml: expected --fit-drift beside it, and a name that ends in .toml")
        if options.output.exists() and not options.force:
            raise InputError(f"{options.output}: is there already, expected another name for the cell, or --force")
    followed = follow_saved(options.campaign, cell, now=options.now, anew=options.anew)
    found, sweeps, notes = followed.track, followed.sweeps, followed.notes
    if again and found.resumed == len(found.outcomes):
        return 0 if found.converged else 1
    lines = verdict_lines(found)
    valid_until_h, note = _valid_until(found, goal, asked=options.task is not None)
    notes += note
    until = ""
    if not found.trust.usable:
        valid_until_h, until = None, f"not valid: {found.trust.against}"
    if valid_until_h is not None:
        exceeds = f"P({', '.join(goal.tasks)} > {options.tolerance_nm:g} nm)"
        holds = f"valid until {time_text(valid_until_h, found.outcomes)}: {exceeds} < {options.level:g}"
        passed = f"not valid: {exceeds} is above {options.level:g} already"
        until = holds if valid_until_h > found.last.time_h else passed
    fitted = fit_sizes(found, check_sessions(sweeps)) if options.fit_drift else None
    if fitted is not None and options.output is not None:
        write_resized_cell(options.cell, *fitted.pace, options.output)
    drift_fit = {} if fitted is None else {"drift_fit": fitted.content()}
    warnings = [f"{o.session}: {text}" for o in found.outcomes for text in o.warnings] + lines + notes
    content = published(found, valid_until_h) | {"warnings": warnings}
    if options.estimate is not None:
        write_result(options.estimate, "track", content)
    if options.flat is not None:
        write_flat(options.flat, flat_content(found.estimate(valid_until_h)))
    write_result(options.json, "track", content | found.content() | drift_fit)
    known = f"{options.campaign}: {counted(len(found.outcomes), 'session')}, {found.resumed} known before"
    title = f"after session {found.last.session}, {time_text(found.last.time_h, found.outcomes)}"
    said = [until] if until else []
    if fitted is not None:
        said += fitted.lines()
        if options.output is not None:
            use = f"fpcal track {options.campaign} --cell {options.output}"
            said.append(f"{options.output}: the cell with these sizes; from now on give it to each command: {use}")
    show(options, [session_table(found, known), parameter_table(found.estimate(), title), *said], warnings)
    return 0 if found.converged else 1


def _valid_until(found: Track, goal: Goal, *, asked: bool) -> tuple[float | None, list[str]]:
    """Until when the estimate holds, in hours, or None and why it cannot be said."""
    try:
        warm_up_inverse(found.cell)
        return valid_until(found, goal), []
    except InputError as error:
        # Not every cell can drive the default task; one that was asked for must be possible.
        if asked:
            raise
        return None, [f"how long the estimate holds cannot be said: {error}"]
