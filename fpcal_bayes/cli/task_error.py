"""``fpcal task-error``: by how many nanometres a task will be off."""

import argparse
from pathlib import Path

from fpcal_bayes.analysis.tasks import judged
from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.infer.tasks.budget import budget_of
from fpcal_bayes.infer.tasks.source import read_knowledge
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import possible_tasks
from fpcal_bayes.report import tasks as words


def run(options: argparse.Namespace, cell: Cell) -> int:
    knowledge = read_knowledge(options.file, cell, held=options.estimate)
    warm_up_inverse(cell)
    given = None if options.tolerance_nm is None else options.tolerance_nm * 1e-3
    content, predictions, budgets, warnings = {}, [], [], []
    own, tolerances, lines = {task.name: task for task in cell.tasks}, [], []
    for name in possible_tasks(cell) if options.task == "all" else [options.task]:
        estimate, task = knowledge.plan(
            name, radius=options.radius_um, n_points=options.points, compensate=options.compensate
        )
        warnings += words.reach_warnings(task)
        if options.task == "all" and not task.ok.any():
            continue
        driven = task.driven()
        prediction = knowledge.predict(estimate, driven, draws=options.draws, seed=options.seed)
        predictions.append(prediction)
        stated = own[name].tolerances if name in own else {}
        tolerances.append(stated.get("beam") if given is None else given)
        content[task.name] = words.prediction_content(prediction, tolerances[-1], task, stated)
        if stated:
            found = judged(prediction, own[name])
            content[task.name]["tolerance_exceeds_probability"] = found
            lines += words.tolerance_lines(own[name], found)
        if options.budget and estimate.trust.usable:
            budget = budget_of(estimate, driven)
            content[task.name]["budget"] = words.budget_content(budget)
            budgets.append(budget)

    if not predictions:
        raise InputError(f"{options.file}: no task can be driven to: {'; '.join(warnings)}")
    warnings += estimate.trust.texts
    write_result(options.json, "task-error", {**estimate.content(), "tasks": content, "warnings": warnings})
    source = "to first order from the covariance" if knowledge.draws is None else "from posterior draws"
    shown: list[object] = [
        words.prediction_table(predictions, tolerances, f"{Path(options.file).name}: task errors {source}"),
        words.freedom_table(predictions),
        words.not_evaluated_line(cell),
    ]
    shown += [*lines, *words.mechanism_lines(predictions)]
    for budget in budgets:
        shown += [words.budget_table(budget), *words.correlation_lines(budget)]
    show(options, shown, warnings)
    return 0
