"""``fpcal rig``: emulate the devices of a cell."""

import argparse
import contextlib
from pathlib import Path

from fpcal_bayes.cli.options import Commands, add_command, cell_of, check_output, console

_EPILOG = """\
All devices of RIG.toml listen on loopback and speak their real protocols; behind them is one simulated cell whose truth
drifts. Port 0 takes a free one: LIVE is RIG.toml with the ports that are open and the clock that runs, for
`fpcal measure --rig LIVE`. [clock] speedup lets the cell's time run faster; [emulate] gives truth, seed, hour and
faults. Ends with Ctrl-C.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "rig", "emulate the devices of a cell", run, _EPILOG)
    parser.add_argument("--emulate", metavar="RIG", required=True, help="devices to emulate: RIG.toml")
    parser.add_argument(
        "-o", dest="output", metavar="LIVE", type=Path, help="rig file to write (default: RIG_live.toml)"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.fit.kernels import warm_up
    from fpcal_bayes.rig.clock import Halt, Halted
    from fpcal_bayes.rig.emulate.bench import EmulatedBench
    from fpcal_bayes.rig.reader import read_rig

    cell = cell_of(options)
    rig = read_rig(options.emulate, cell)
    source = Path(options.emulate)
    output = options.output or source.with_name(f"{source.stem}_live.toml")
    check_output(output, options.emulate)
    warm_up(cell)
    halt = Halt()
    with halt.on_signals():
        emulated = EmulatedBench(rig, cell)
        emulated.write_live(output)
        listening = ", ".join(f"{name} at {end.address}" for name, end in emulated.server.endpoints.items())
        console(options).print(f"{listening} -> {output}", markup=False, soft_wrap=True)
        with contextlib.suppress(Halted):
            emulated.run(halt)
    halt.close()
    return 0
