"""``fpcal compare``: which of several models the data favour."""

import argparse
import sys

from rich.console import Console

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    seed,
    warn,
    write_result,
)
from fpcal_bayes.infer.fit.kernels import warm_up

_EPILOG = """\
Models stand between commas, settings of one model between plus signs: `opd=axis,opd=perpendicular`, or
`likelihood=gaussian,opd=perpendicular+likelihood=slip`. What is not set is the cell's path model and Gaussian noise.

Models are compared by how well they predict each row from all others (leave-one-out): elpd is the sum of these log
densities, per um. Rows whose Pareto k is too large for importance sampling ("bad k") are left out in earnest
("refitted"). A difference below 4, or below twice its standard error, tells nothing.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "compare", "say which of several models the data favour", run, _EPILOG)
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument(
        "--models", required=True, metavar="MODEL,MODEL,..", help="e.g. opd=axis,opd=perpendicular,likelihood=slip"
    )
    parser.add_argument("--session", metavar="NAME", help="session to use (default: the first)")
    parser.add_argument("--draws", type=count, default=2000, help="effective draws of every parameter (default: 2000)")
    parser.add_argument("--seed", type=seed, default=0, help="of the draws (default: 0)")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.posterior.compare import compare, parse_models
    from fpcal_bayes.io.sweeps import read_sweeps
    from fpcal_bayes.report.posterior import compare_table

    cell = cell_of(options)
    check_output(options.json, options.file)
    specs = parse_models(options.models, cell)
    sweeps = read_sweeps(options.file, cell).of_session(options.session)
    warm_up(cell)
    status = Console(stderr=True, quiet=options.quiet or not sys.stderr.isatty()).status("")
    with status:
        comparison = compare(cell, sweeps, specs, draws=options.draws, seed=options.seed, progress=status.update)

    out = console(options)
    out.print(compare_table(comparison, f"{options.file}, session {sweeps.sessions[0]}: {len(sweeps)} rows"))
    out.print(f"verdict: {comparison.verdict}", markup=False, soft_wrap=True)
    warn(comparison.warnings)
    write_result(options.json, "compare", comparison.content())
    return 0 if comparison.sound else 1
