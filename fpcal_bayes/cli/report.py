"""``fpcal report``: one page that says how good the cell is, what to do next, and why to believe it."""

import argparse
import shlex
from pathlib import Path

from fpcal_bayes.analysis.history import since_calibration
from fpcal_bayes.cli.common import console, show, write_result
from fpcal_bayes.cli.driven import goal_of
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.kernels import warm_up, warm_up_inverse
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.campaign.page import write_campaign_report
from fpcal_bayes.report.campaign.words import since_content, standing, verdict


def run(options: argparse.Namespace, cell: Cell) -> int:
    goal = goal_of(options, cell)
    try:
        warm_up_inverse(cell)
    except InputError:
        # A cell whose joints cannot be solved for a pose has a report too, without tasks.
        warm_up(cell)
    with console(options).status("working out the report"):
        facts = write_campaign_report(
            options.campaign,
            cell,
            options.output,
            goal=goal,
            now=options.now,
            posterior=options.posterior,
            verification=options.verification,
            command=_command(options),
        )
    said = verdict(facts)
    tasks = {outlook.name: standing(outlook, facts)[0] for outlook in facts.tasks}
    content = {"verdict": said.word, "meaning": said.meaning, "sentences": list(said.sentences), "tasks": tasks}
    since = since_content(since_calibration(facts))
    write_result(options.json, "report", facts.estimate.content() | {"report": content | {"since_calibration": since}})
    show(options, (f"{said.title}. {said.meaning}", *said.sentences, f"-> {options.output}"), facts.trust.texts)
    # The reason why numbers are not to be used stands in the page; a fit that failed is an exit status too.
    return 1 if any(reason.kind == "not-converged" for reason in facts.trust.reasons) else 0


def _command(options: argparse.Namespace) -> str:
    words = ["fpcal", "report", Path(options.campaign).name, "-o", options.output.name]
    for name in ("posterior", "verification"):
        if getattr(options, name) is not None:
            words += [f"--{name}", Path(getattr(options, name)).name]
    words += ["--tolerance-nm", f"{options.tolerance_nm:g}", "--level", f"{options.level:g}"]
    for task in options.task or ():
        words += ["--task", Path(task).name]
    if options.now is not None:
        words += ["--now", options.now]
    return shlex.join(words)
