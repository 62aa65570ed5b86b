"""``fpcal identify``: find the parameters of a cell from a file of sweeps."""

import argparse

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    add_prior,
    cell_of,
    check_output,
    console,
    prior_of,
    warn,
    with_source,
    write_result,
)
from fpcal_bayes.infer.fit.kernels import warm_up

_EPILOG = """\
--free takes groups and names, for example `--free extrinsic` or `--free all,gain_4`. Parameters that are not free are
held at --start (or at nominal), and their uncertainty reaches the result; --hold exact takes them as known.

Status of a parameter: identified (the data tell it); weak (the data halve its prior variance at best); gauge (the data
see it only together with others: its value is the prior's); fixed (held).
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "identify", "find the parameters of a cell from sweeps", run, _EPILOG)
    parser.add_argument("file", metavar="FILE", help="sweeps: CSV, or HDF5 campaign")
    parser.add_argument("--session", metavar="NAME", help="session to use (default: the first)")
    parser.add_argument("--free", default="all", metavar="all|intrinsic|extrinsic|NAME,..", help="what to identify")
    parser.add_argument("--start", metavar="ESTIMATE", help="estimate JSON to start from and to hold the rest at")
    add_prior(parser)
    parser.add_argument("--hold", choices=("consider", "exact"), default="consider", help="how to hold the rest")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.fit.identify import identify
    from fpcal_bayes.infer.tasks.source import draws_content
    from fpcal_bayes.io.estimate import read_estimate
    from fpcal_bayes.io.sweeps import read_sweeps
    from fpcal_bayes.report.fit import fit_lines, parameter_table

    cell = cell_of(options)
    check_output(options.json, options.file, options.start, options.prior)
    sweeps = read_sweeps(options.file, cell).of_session(options.session)
    start = None if options.start is None else read_estimate(options.start, cell)
    prior = prior_of(options, cell)
    cell.select(options.free)
    warm_up(cell)
    found = identify(cell, sweeps, free=options.free, start=start, hold=options.hold, prior=prior)
    result = with_source(found, options.file, sweeps.sessions[0])

    out = console(options)
    title = f"{options.file}, session {sweeps.sessions[0]}: {len(result.problem.sweeps)} rows"
    out.print(parameter_table(result.estimate, title))
    for line in fit_lines(result):
        out.print(line, markup=False, soft_wrap=True)
    warn(result.warnings)
    if options.json is not None:
        write_result(options.json, "identify", {**result.content(), **draws_content(result)})
    return 0 if result.converged else 1
