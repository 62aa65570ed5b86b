"""``fpcal plan --validation N``: sweeps that would show an error of the tasks, for `fpcal verify`."""

import argparse

import numpy as np

import fpcal_bayes.report as report
from fpcal_bayes.cli.common import about, show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.design.candidates import SweepLimits
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.infer.verification.choice import READINGS, validation_plan
from fpcal_bayes.infer.verification.power import LEVEL
from fpcal_bayes.infer.verification.verify import LEAST_POWER
from fpcal_bayes.io.sweeps import read_sweeps, write_sweeps
from fpcal_bayes.io.tickets import write_plan
from fpcal_bayes.measure.ticket import Ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.plan import sweeps_table


def write_planned(options: argparse.Namespace, planned: Ticket, cell: Cell) -> None:
    """Write a plan, and where they are asked for its rows and its picture."""
    write_plan(options.output, planned, cell)
    if options.rows is not None:
        write_sweeps(options.rows, planned.rows(), cell)
    if options.figure is not None and planned.plan is not None:
        report.save_figure(report.draw_plan(cell, planned.plan), options.figure)


def run(options: argparse.Namespace, cell: Cell, limits: SweepLimits) -> int:
    """Write the plan."""
    if options.after is None:
        raise InputError("--validation: expected --after FILE, the sweeps of the calibration that is to be verified")
    calibration = read_sweeps(options.after, cell).of_session(options.session)
    warm_up_inverse(cell)
    found = identify(cell, calibration)
    made = validation_plan(
        found,
        options.validation,
        readings=options.readings or READINGS,
        sigma=options.sigma_nm * 1e-3,
        limits=limits,
        tasks=None if options.tasks is None else [name.strip() for name in options.tasks.split(",") if name.strip()],
        radius=options.radius_um,
        seed=options.seed,
    )
    least = {task: min(kinds.values(), default=1.0) for task, kinds in made.power.items()}
    weak = [f"{task} {100 * p:.0f} %" for task, p in least.items() if p < LEAST_POWER]
    warnings = found.estimate.trust.texts
    if weak:
        warnings.append(
            f"these sweeps may miss an error beyond the tolerance: power {', '.join(weak)}; expected more of them, or "
            "more readings of each"
        )
    write_planned(options, Ticket(str(options.output), made.sweeps, np.full(len(made.sweeps), made.readings)), cell)
    content = {"n_sweeps": len(made.sweeps), "readings": made.readings, "level": LEVEL, "power": made.power}
    write_result(options.json, "plan", about(cell) | content | {"warnings": warnings}, found.estimate.trust)
    title = f"{options.output}: {counted(len(made.sweeps), 'sweep')} of {made.readings} readings"
    told = ", ".join(f"{task} {100 * p:.0f} %" for task, p in least.items())
    power = f"power at the kind of error found least likely: {told}"
    then = f"then: fpcal verify {options.after} --validation MEASURED"
    show(options, [sweeps_table(cell, made.sweeps, title), power, then], warnings)
    return 0
