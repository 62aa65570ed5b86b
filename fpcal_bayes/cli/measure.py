"""``fpcal measure``: drive a ticket on the live cell."""

import argparse
import sys
from pathlib import Path

from fpcal_bayes.cli.common import console, warn
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import make_folder
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Ticket, orders_of
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.table import plain_table
from fpcal_bayes.rig.agenda import Agenda, origin_of
from fpcal_bayes.rig.bench import Bench, only_one
from fpcal_bayes.rig.clock import Halt, Halted
from fpcal_bayes.rig.drivers.interface import CommandLog
from fpcal_bayes.rig.reader import read_rig
from fpcal_bayes.rig.route import Guard, Leg, dry_run, total_seconds
from fpcal_bayes.rig.session import Failed, Progress, Summary, measure
from fpcal_bayes.rig.settings import ProgramDevice, Rig


def run(options: argparse.Namespace, cell: Cell) -> int:
    ticket = read_ticket(options.ticket, cell)
    if ticket.plan is None:
        console(options).say(f"{options.ticket}: no rows, nothing to measure")
        return 0
    rig = read_rig(options.rig, cell)
    warm_up(cell)
    guard = Guard(cell, rig, None if options.estimate is None else read_estimate(options.estimate, cell))
    if options.dry_run:
        return _show(options, cell, guard, ticket)
    campaign = None if options.campaign is None else read_sweeps(options.campaign, cell)
    return 1 if drive(options, cell, rig, guard, ticket, campaign).left else 0


def drive(
    options: argparse.Namespace, cell: Cell, rig: Rig, guard: Guard, ticket: Ticket, campaign: Sweeps | None
) -> Agenda:
    """Drive a ticket of a campaign, as the options `output` and those of the screen say."""
    command = f"fpcal measure {Path(options.ticket).name} --rig {Path(options.rig).name}"
    agenda = Agenda(ticket, cell, rig, options.output, origin_of(ticket, campaign, rig.clock.now()), command)
    if isinstance(rig.instrument, ProgramDevice):
        make_folder(agenda.folder)
    if agenda.resumed:
        done = f"{len(agenda.outcomes)} of {len(agenda.orders)} sweeps"
        warn([f"{options.output}: goes on after {done}; its axes are stopped first"])
    halt, log = Halt(), CommandLog(options.output.with_suffix(".log"), rig.clock)
    try:
        with only_one(rig), halt.on_signals():
            summary = measure(agenda, Bench(cell, rig, guard, halt, log, agenda.folder), guard, _Teller(options))
    except Failed as failed:
        _report(options, failed.summary)
        warn(failed.unsure)
        if isinstance(failed.__cause__, Halted):
            raise KeyboardInterrupt from failed
        raise failed.__cause__ or InputError(str(failed)) from None
    finally:
        log.close()
        halt.close()
    _report(options, summary)
    return agenda


def _show(options: argparse.Namespace, cell: Cell, guard: Guard, ticket: Ticket) -> int:
    orders = orders_of(ticket)
    legs = dry_run(guard, orders, guard.inside(orders[0].start))
    heads = ["sweep", "moves", "time [s]", "least gap [um]", "fringes a second, most"]
    table = plain_table(f"{options.ticket}: what would be driven", heads, words=(0,))
    for order, moves in zip(orders, legs, strict=True):
        table.add_row(order.label, str(len(moves)), f"{total_seconds([moves]):.1f}", *_extremes(moves))
    every = [leg for moves in legs for leg in moves]
    out, (gap, rate) = console(options), _extremes(every)
    out.print(table)
    out.say(
        f"{counted(len(orders), 'sweep')}, {counted(len(every), 'move')}, {total_seconds(legs) / 60.0:.1f} min from "
        f"the first sweep's start; least gap {gap} um, at most {rate} fringes a second; no move was made"
    )
    return 0


def _extremes(legs: list[Leg]) -> tuple[str, str]:
    return f"{min(leg.gap for leg in legs):.1f}", f"{max(leg.fringe_rate for leg in legs):.3g}"


class _Teller:
    """Prints how far a session is: each sweep on a terminal, about ten lines elsewhere."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._out = console(options)
        self._often = sys.stdout.isatty()

    def __call__(self, progress: Progress) -> None:
        if progress.doubt:
            warn([f"{progress.label}: {progress.doubt}"])
        if self._often or progress.done % max(1, progress.total // 10) == 0 or progress.done == progress.total:
            what = f"{progress.done} of {progress.total} sweeps, {progress.left_s / 60.0:.1f} min left"
            self._out.print(what, markup=False)


def _report(options: argparse.Namespace, summary: Summary) -> None:
    where = f" -> {options.output}" if summary.rows else ""
    doubtful = f", {summary.doubtful} doubtful" if summary.doubtful else ""
    what = f"{summary.done} of {summary.total} sweeps driven{doubtful}, {summary.rows} rows{where}: {summary.reason}"
    console(options).say(what)
