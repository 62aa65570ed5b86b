"""``fpcal rig``: emulate the devices of a cell."""

import argparse
import contextlib
from pathlib import Path

from fpcal_bayes.cli.common import console
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.rig.clock import Halt, Halted
from fpcal_bayes.rig.emulate.bench import EmulatedBench
from fpcal_bayes.rig.reader import read_rig
from fpcal_bayes.simulator.sweeps import machine_of


def run(options: argparse.Namespace, cell: Cell) -> int:
    rig = read_rig(options.emulate, cell)
    source = Path(options.emulate)
    output = options.output or source.with_name(f"{source.stem}_live.toml")
    warm_up(cell)
    halt = Halt()
    with halt.on_signals():
        emulated = EmulatedBench(rig, cell)
        if cell.mechanics is not None:
            emulated.lab.machine = machine_of(cell, emulated.lab.truth, rig.emulation.seed)
        emulated.write_live(output)
        listening = ", ".join(f"{name} at {end.address}" for name, end in emulated.server.endpoints.items())
        console(options).say(f"{listening} -> {output}")
        with contextlib.suppress(Halted):
            emulated.run(halt)
    halt.close()
    return 0
