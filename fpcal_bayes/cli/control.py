"""``fpcal control``: the joint path of a task, with what has been identified."""

import argparse
import sys
from pathlib import Path

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    positive,
    warn,
    write_result,
)
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.model.cell.cell import Cell

_EPILOG = """\
TASK is circle, line-x, line-z, tilt-x, tilt-z, spin, or a PATH.csv with the columns x_um,y_um,z_um,rx_deg,ry_deg,rz_deg
in the fibre frame, relative to the aligned pose, turns in the order x, y, z about the reflection point.

JOINTS has the columns q1_um .. q6_deg, status (ok, or the reason), predicted_sd_nm (what the cavity length may be off
by, one standard deviation, from the aligned pose to this one). Points that are not ok have neither joint values nor a
prediction, and do not count for the peak to peak.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "control", "find the joint path of a task", run, _EPILOG)
    parser.add_argument(
        "--estimate", metavar="ESTIMATE|POSTERIOR", required=True, help="estimate JSON, or posterior draws (.nc)"
    )
    add_task_options(parser, required=True)
    parser.add_argument(
        "--now", metavar="TIME_H|UTC", help="when the task is driven: says if the estimate is past its horizon "
        "(default: this clock, where the estimate carries a clock time)"
    )  # fmt: skip
    parser.add_argument("-o", dest="output", metavar="JOINTS", type=Path, required=True, help=".csv or .mat to write")
    add_json(parser)


def add_task_options(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """Add the options that choose a task."""
    parser.add_argument(
        "--task", metavar="TASK", required=required, default="all", help="task by name, or a path CSV (see below)"
    )
    parser.add_argument("--radius-um", type=positive, default=100.0, metavar="R", help="of the circle (default: 100)")
    parser.add_argument("--points", type=count, default=61, metavar="N", help="points of the path (default: 61)")


def warm_up_inverse(cell: Cell) -> None:
    """Load the kernels of lengths and of the inverse model; say so if they have to be compiled first."""
    from fpcal_bayes.model.inverse import InverseModel
    from fpcal_bayes.model.kernels.compile import needs_compilation
    from fpcal_bayes.model.kernels.inverse import batch_inverse

    inverse = InverseModel(cell)
    warm_up(cell)
    if len(cell.joints) == 6 and needs_compilation(batch_inverse):
        print("fpcal: compiling the inverse model; this happens once and takes about 30 s", file=sys.stderr)
    nominal = cell.parameters.nominal
    inverse.solve(nominal, inverse.tool_poses(nominal, inverse.home[None]))


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    import numpy as np

    from fpcal_bayes.infer.tasks.source import read_knowledge
    from fpcal_bayes.io.joint_paths import check_suffix, write_joints
    from fpcal_bayes.motion.validity import read_now, stale_text
    from fpcal_bayes.report.tasks import prediction_content, prediction_table, reach_warnings

    cell = cell_of(options)
    check_suffix(options.output)
    check_output(options.output, options.estimate, options.task)
    check_output(options.json, options.estimate, options.task, options.output)
    knowledge = read_knowledge(options.estimate, cell)
    warm_up_inverse(cell)
    estimate, task = knowledge.plan(options.task, radius=options.radius_um, n_points=options.points)
    stale = stale_text(estimate, read_now(options.now, estimate))
    prediction = knowledge.predict(estimate, task.driven())
    sd = np.full(len(task), np.nan)
    sd[task.ok] = prediction.sd
    write_joints(options.output, cell, task.q, task.status, sd, task=task.name)

    warnings = reach_warnings(task) + ([] if stale is None else [stale])
    console(options).print(
        prediction_table([prediction], None, f"{options.output}: {task.ok.sum()} of {len(task)} points")
    )
    warn(warnings)
    content = {
        **estimate.content(),
        "tasks": {task.name: prediction_content(prediction, None, task)},
        "warnings": warnings,
    }
    write_result(options.json, "control", content)
    return 0
