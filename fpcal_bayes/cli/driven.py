"""What the commands that drive tasks have in common."""

import argparse

import numpy as np

from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import possible_tasks

#: Largest peak to peak in nm that is asked for where neither the command nor the task says another.
_TOLERANCE_NM = 50.0


def goal_of(options: argparse.Namespace, cell: Cell) -> Goal:
    """The goal that the options name; a task of the cell's own brings its tolerance, and the smallest counts."""
    tasks = tuple(dict.fromkeys(options.task or possible_tasks(cell, ("circle",)) or possible_tasks(cell)[:1]))
    own = {task.name: 1e3 * task.tolerances["beam"] for task in cell.tasks if "beam" in task.tolerances}
    if options.tolerance_nm is None:
        options.tolerance_nm = min(own.get(name, _TOLERANCE_NM) for name in tasks) if tasks else _TOLERANCE_NM
    return Goal(options.tolerance_nm, tasks, options.level, options.radius_um, options.compensate)


def costs_of(options: argparse.Namespace, sweeps: Sweeps) -> Costs:
    """What measuring costs, by the options of `fpcal decide`; `sweeps` are those of the campaign."""
    most = max(options.most_sweeps, options.least_sweeps)
    return Costs(
        minutes_per_sweep=options.minutes_per_sweep,
        minutes_per_session=options.minutes_per_session or 0.0,
        least_sweeps=options.least_sweeps,
        most_sweeps=most,
        sigma_nm=1e3 * float(np.median(sweeps.sigma)) if options.sigma_nm is None else options.sigma_nm,
        horizon_h=options.horizon_h,
        diagnosis_h=options.diagnose_every_h,
        diagnosis_sweeps=min(Costs.diagnosis_sweeps, most),
    )
