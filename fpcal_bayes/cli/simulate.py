"""``fpcal simulate``: measure sweeps on a simulated cell."""

import argparse
from pathlib import Path

from fpcal_bayes.cli.common import (
    Commands,
    add_command,
    cell_of,
    check_output,
    console,
    positive,
    seed,
    warm_up,
)

_EPILOG = """\
The truth is by default what the paper's full identifications found, linear in time between them. A TOML file gives
another one: a table [parameters] with lines like `alpha_2 = -90.1` (um, deg; what is not named is nominal), or several
[[epoch]] tables with `time_h` and [epoch.parameters].
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "simulate", "measure sweeps on a simulated cell", run, _EPILOG)
    parser.add_argument(
        "-o", dest="output", metavar="FILE", type=Path, required=True, help="sweeps to write: .csv or .h5"
    )
    parser.add_argument("--truth", metavar="TOML", help="true parameters (default: those of the paper)")
    parser.add_argument(
        "--protocol",
        default="paper",
        metavar="paper|paper-mid|SWEEPS.csv",
        help="which sweeps: the paper's 69, the same with a midpoint each, or those of a file (default: paper)",
    )
    parser.add_argument(
        "--signs", choices=("all", "paper"), help="paper: the direction of dL is known for X and Z translations only"
    )
    parser.add_argument("--sigma-nm", type=positive, default=5.0, help="standard deviation of each dL (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, help="of the noise (default: 0)")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.measure.campaign import Campaign, write_campaign
    from fpcal_bayes.measure.protocol import mark_signs, protocol_by_name
    from fpcal_bayes.measure.rig import simulate
    from fpcal_bayes.measure.sweep_files import HDF5_SUFFIXES, read_sweeps, write_sweeps
    from fpcal_bayes.measure.truth import paper_truth, read_truth

    cell = cell_of(options)
    planned = options.protocol not in ("paper", "paper-mid")
    check_output(options.output, options.protocol if planned else None, options.truth)
    plan = read_sweeps(options.protocol, cell, plan=True) if planned else protocol_by_name(options.protocol, cell)
    if options.signs is not None:
        plan = mark_signs(plan, options.signs)
    truth = paper_truth(cell) if options.truth is None else read_truth(options.truth, cell)
    warm_up(cell)
    sweeps = simulate(cell, truth, plan, sigma=options.sigma_nm * 1e-3, seed=options.seed)
    command = f"fpcal simulate --protocol {options.protocol} --sigma-nm {options.sigma_nm:g} --seed {options.seed}"
    if options.output.suffix.lower() in HDF5_SUFFIXES:
        campaign = Campaign.of(sweeps, cell, command=command, seed=options.seed, truth=truth.record())
        write_campaign(options.output, campaign, cell)
    else:
        write_sweeps(options.output, sweeps, cell)
    unsigned = int((~sweeps.signed).sum())
    signs = f", the direction of {unsigned} unknown" if unsigned else ""
    console(options).print(
        f"{len(sweeps)} rows simulated on cell {cell.name!r}, sd {options.sigma_nm:g} nm{signs} -> {options.output}",
        soft_wrap=True,
        markup=False,
    )
    return 0
