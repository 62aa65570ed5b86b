"""``fpcal control``: the joint path of a task, with what has been identified."""

import argparse

import numpy as np

from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.infer.tasks.source import read_knowledge
from fpcal_bayes.io.joint_paths import write_joints
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import no_envelope_text, require_task_within_envelope
from fpcal_bayes.motion.validity import judged_at, read_now
from fpcal_bayes.report.tasks import mechanism_lines, prediction_content, prediction_table, reach_warnings


def run(options: argparse.Namespace, cell: Cell) -> int:
    require_suffix(options.output, ".csv", ".mat")
    knowledge = read_knowledge(options.estimate, cell)
    warm_up_inverse(cell)
    estimate, task = knowledge.plan(
        options.task, radius=options.radius_um, n_points=options.points, compensate=options.compensate
    )
    model, draws = knowledge.drawn(estimate)
    require_task_within_envelope(model, draws, task.q[task.ok], name=task.name)
    estimate = judged_at(estimate, read_now(options.now, estimate))
    prediction = knowledge.predict(estimate, task.driven())
    sd = np.full(len(task), np.nan)
    if prediction.trust.usable:
        sd[task.ok] = prediction.sd
    write_joints(options.output, cell, task.q, task.status, sd, task=task.name)
    warnings = [*no_envelope_text(model, draws), *reach_warnings(task), *prediction.trust.texts]
    content = {"tasks": {task.name: prediction_content(prediction, None, task)}, "warnings": warnings}
    write_result(options.json, "control", estimate.content() | content)
    title = f"{options.output}: {task.ok.sum()} of {len(task)} points"
    show(options, [prediction_table([prediction], [None], title), *mechanism_lines([prediction])], warnings)
    return 0
