"""What the commands that drive tasks have in common."""

import argparse
import sys

from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.inverse import InverseModel
from fpcal_bayes.model.kernels.compile import needs_compilation
from fpcal_bayes.model.kernels.inverse import batch_inverse


def goal_of(options: argparse.Namespace) -> Goal:
    """The goal that the options name."""
    tasks = tuple(dict.fromkeys(options.task or ["circle"]))
    return Goal(options.tolerance_nm, tasks, options.level, options.radius_um, options.compensate)


def warm_up_inverse(cell: Cell) -> None:
    """Load the kernels of lengths and of the inverse model; say so if they have to be compiled first."""
    inverse = InverseModel(cell)
    warm_up(cell)
    if len(cell.joints) == 6 and needs_compilation(batch_inverse):
        print("fpcal: compiling the inverse model; this happens once and takes about 30 s", file=sys.stderr)
    nominal = cell.parameters.nominal
    inverse.solve(nominal, inverse.tool_poses(nominal, inverse.home[None]))
