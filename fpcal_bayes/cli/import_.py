"""``fpcal import``: what the controllers logged, as sweeps."""

import argparse

from fpcal_bayes.cli.common import console
from fpcal_bayes.core.files import require_suffix
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.io.moves import read_moves
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES, write_sweeps
from fpcal_bayes.model.cell.cell import Cell


def run(options: argparse.Namespace, cell: Cell) -> int:
    require_suffix(options.output, ".csv", *HDF5_SUFFIXES)
    sweeps = read_moves(options.log, cell, session=options.session, time_h=options.time_h)
    write_sweeps(options.output, sweeps, cell)
    what = "measured" if sweeps.measured else "a plan, without lengths"
    console(options).say(f"{options.log}: {counted(len(sweeps), 'row')}, {what} -> {options.output}")
    return 0
