"""``fpcal decide``: whether to measure now, and what."""

import argparse
from typing import Any

from fpcal_bayes.analysis.campaign import Followed, follow
from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.cli.driven import costs_of, goal_of
from fpcal_bayes.decision.decision import Costs, Decision
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.decision.policy import decide_track, valid_until
from fpcal_bayes.decision.ticket import ticket_of
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.io.tickets import write_ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.report import track as words
from fpcal_bayes.tracking.sessions import hours_now


def run(options: argparse.Namespace, cell: Cell) -> int:
    goal = goal_of(options, cell)
    warm_up_inverse(cell)
    followed = follow(options.campaign, cell, now=options.now)
    found, sweeps = followed.track, followed.sweeps
    decision, content = decided(followed, goal, costs_of(options, sweeps), followed.now_h)
    ticket = ticket_of(decision, sweeps, str(options.output))
    if options.output is not None:
        write_ticket(options.output, ticket, cell)
    write_result(options.json, "decide", found.estimate().content() | content)
    few = decision.sweeps if decision.action == "extrinsic" else None
    tables = [words.outlook_table(decision, goal, found), *([] if few is None else [words.sweep_table(few, cell)])]
    show(options, [*tables, words.decision_sentence(decision, found)], content["warnings"])
    return 0 if found.converged else 1


def decided(followed: Followed, goal: Goal, costs: Costs, now_h: float | None) -> tuple[Decision, dict[str, Any]]:
    """The decision at a time, by default now, and its JSON: ``decision``, ``ticket``, ``warnings``."""
    found, sweeps = followed.track, followed.sweeps
    if now_h is None:
        now_h = hours_now(sweeps, found.last.time_h)
    decision = decide_track(found, sweeps, goal, costs, now_h)
    warnings = [*words.verdict_lines(found), *followed.notes]
    warnings += [] if decision.attainable_nm is None else [decision.reason]
    estimate = found.estimate()
    trust = estimate.trust
    warnings += [text for text in trust.texts if text not in warnings]
    for name in goal.tasks:
        task = find_task(found.cell, estimate.vector(), name, radius=goal.radius_um, n_points=8)
        if not task.ok.any():
            warnings.append(f"task {name!r} is judged as far as the joints turn: {task.status[0]}")
    until_h = valid_until(found, goal)
    if trust.usable and now_h > until_h:
        until = words.time_text(until_h, found.outcomes)
        what = f"the estimate of session {found.last.session} was valid until {until}, {now_h - until_h:.1f} h ago"
        warnings.append(what)
    ticket = ticket_of(decision, sweeps).content()
    return decision, {"decision": words.decision_content(decision, goal, found), "ticket": ticket, "warnings": warnings}
