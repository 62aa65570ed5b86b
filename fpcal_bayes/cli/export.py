"""``fpcal export``: a plan or a joint path as moves of the controllers."""

import argparse
from pathlib import Path

from fpcal_bayes.cli.common import console, warn
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.io.csv import read_records
from fpcal_bayes.io.joint_paths import read_joint_path
from fpcal_bayes.io.moves import write_order_moves, write_path_moves
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.ticket import orders_of
from fpcal_bayes.model.cell.cell import Cell


def run(options: argparse.Namespace, cell: Cell) -> int:
    require_suffix(options.output, ".csv", ".mat")
    if cell.joint_columns[0] in read_records(Path(options.file), "a header and a plan or joint path").header:
        q = read_joint_path(options.file, cell)
        write_path_moves(options.output, q, cell)
        said = f"{len(q)} points of a path"
    else:
        ticket = read_ticket(options.file, cell)
        if ticket.plan is None:
            raise InputError(f"{options.file}: no rows, nothing is to be measured")
        orders = orders_of(ticket)
        write_order_moves(options.output, orders, cell)
        said = f"{counted(len(orders), 'sweep')} with {counted(sum(len(order.targets) for order in orders), 'reading')}"
        if any(order.whole for order in orders):
            warn(["whole traces are asked for: record the irradiance from the start of such a sweep to its end"])
    console(options).say(f"{options.file}: {said} -> {options.output}")
    return 0
