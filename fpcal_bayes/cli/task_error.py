"""``fpcal task-error``: by how many nanometres a task will be off."""

import argparse
from pathlib import Path

from fpcal_bayes.cli.control import add_task_options, warm_up_inverse
from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    positive,
    seed,
    warn,
    write_result,
)
from fpcal_bayes.core.errors import InputError

_EPILOG = """\
TASK is circle, line-x, line-z, tilt-x, tilt-z, spin, all of these (the default), or a PATH.csv (see fpcal control).

The task error is the change of cavity length along the task that the controller does not know of, where the joints can
follow. It is worked out from posterior draws, which an estimate of fpcal identify holds too (500); from an estimate
without draws, to first order from its covariance. --budget prints the uncertainty budget of the worst point (GUM, JCGM
100 and 101), always to first order; with --sweeps, the file that the estimate was made from, it tells the noise, the
prior and the wavelength apart.

Of bands of 95 % after the paper's end-point sweeps 94 to 95 % hold the true value in simulation, for every task; to
first order from the covariance 91 % do for spin, 93 to 95 % for the others (studies/task_coverage.py).
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "task-error", "predict by how much tasks will be off", run, _EPILOG)
    parser.add_argument("file", metavar="ESTIMATE|POSTERIOR", help="estimate JSON, or posterior draws (.nc)")
    add_task_options(parser, required=False)
    parser.add_argument(
        "--tolerance-nm", type=positive, metavar="T", help="probability that the peak to peak exceeds T"
    )
    parser.add_argument("--estimate", metavar="ESTIMATE", help="with draws: what the controller holds")
    parser.add_argument("--draws", type=count, default=10_000, help="errors to draw from a covariance (default: 10000)")
    parser.add_argument("--seed", type=seed, default=0, help="of these draws (default: 0)")
    parser.add_argument("--budget", action="store_true", help="print the uncertainty budget of each task")
    parser.add_argument("--sweeps", metavar="FILE", help="with --budget: sweeps that the estimate was made from")
    parser.add_argument("--session", metavar="NAME", help="session of these sweeps (default: the first)")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.tasks.budget import budget_of
    from fpcal_bayes.infer.tasks.source import read_knowledge
    from fpcal_bayes.io.sweeps import read_sweeps
    from fpcal_bayes.motion.tasks import possible_tasks
    from fpcal_bayes.report.tasks import (
        budget_content,
        budget_table,
        correlation_lines,
        prediction_content,
        prediction_table,
        reach_warnings,
    )

    cell = cell_of(options)
    check_output(options.json, options.file, options.task, options.estimate, options.sweeps)
    sweeps = None
    if options.sweeps is not None:
        sweeps = read_sweeps(options.sweeps, cell).of_session(options.session)
    if options.sweeps is not None and not options.budget:
        raise InputError(f"{options.sweeps}: --sweeps is taken with --budget only")
    knowledge = read_knowledge(options.file, cell, held=options.estimate)
    warm_up_inverse(cell)
    tolerance = None if options.tolerance_nm is None else options.tolerance_nm * 1e-3
    out, content, predictions, budgets, warnings = console(options), {}, [], [], []
    for name in possible_tasks(cell) if options.task == "all" else [options.task]:
        estimate, task = knowledge.plan(name, radius=options.radius_um, n_points=options.points)
        warnings += reach_warnings(task)
        driven = task.driven()
        prediction = knowledge.predict(estimate, driven, draws=options.draws, seed=options.seed)
        predictions.append(prediction)
        content[task.name] = prediction_content(prediction, tolerance, task)
        if options.budget:
            budget = budget_of(estimate, driven, sweeps=sweeps)
            content[task.name]["budget"] = budget_content(budget)
            budgets.append(budget)

    source = "to first order from the covariance" if knowledge.draws is None else "from posterior draws"
    out.print(prediction_table(predictions, tolerance, f"{Path(options.file).name}: task errors {source}"))
    for budget in budgets:
        out.print(budget_table(budget))
        for line in correlation_lines(budget):
            out.print(line, markup=False, soft_wrap=True)
    warn(warnings)
    write_result(options.json, "task-error", {**estimate.content(), "tasks": content, "warnings": warnings})
    return 0
