"""``fpcal decide``: whether to measure now, and what."""

import argparse

from fpcal_bayes.analysis.campaign import follow
from fpcal_bayes.cli.common import cell_of, console, warn, write_result
from fpcal_bayes.cli.driven import costs_of, goal_of, warm_up_inverse
from fpcal_bayes.decision.policy import decide_track, valid_until
from fpcal_bayes.decision.ticket import ticket_of
from fpcal_bayes.io.tickets import write_ticket
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.report.track import (
    decision_content,
    decision_sentence,
    outlook_table,
    sweep_table,
    time_text,
    verdict_lines,
)
from fpcal_bayes.tracking.sessions import hours_now


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    cell = cell_of(options)
    goal = goal_of(options, cell)
    warm_up_inverse(cell)
    followed = follow(options.campaign, cell, now=options.now)
    found, sweeps = followed.track, followed.sweeps
    costs = costs_of(options, sweeps)
    now_h = followed.now_h
    if now_h is None:
        now_h = hours_now(sweeps, found.last.time_h)
    decision = decide_track(found, sweeps, goal, costs, now_h)

    warnings = verdict_lines(found) + followed.notes + ([] if decision.attainable_nm is None else [decision.reason])
    estimate = found.estimate()
    warnings += [reason.text for reason in estimate.trust.reasons if reason.text not in warnings]
    for name in goal.tasks:
        task = find_task(cell, estimate.vector(), name, radius=goal.radius_um, n_points=8)
        if not task.ok.any():
            warnings.append(f"task {name!r} is judged as far as the joints turn: {task.status[0]}")
    until_h = valid_until(found, goal)
    if estimate.trust.usable and now_h > until_h:
        until = time_text(until_h, found.outcomes)
        warnings.append(
            f"the estimate of session {found.last.session} was valid until {until}, {now_h - until_h:.1f} h ago"
        )
    ticket = ticket_of(decision, sweeps, str(options.output))
    if options.output is not None:
        write_ticket(options.output, ticket, cell)
    content = {"decision": decision_content(decision, goal, found), "ticket": ticket.content(), "warnings": warnings}
    write_result(options.json, "decide", estimate.content() | content)
    out = console(options)
    out.print(outlook_table(decision, goal, found))
    if decision.sweeps is not None and decision.action == "extrinsic":
        out.print(sweep_table(decision.sweeps, cell))
    out.say(decision_sentence(decision, found))
    warn(warnings)
    return 0 if found.converged else 1
