"""``fpcal observe``: what sweeps can tell about a cell, measured or not."""

import argparse
from pathlib import Path

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    positive,
    share,
    warn,
    write_result,
)
from fpcal_bayes.infer.fit.kernels import warm_up

_EPILOG = """\
FILE may be a plan, without dl_um and sigma_um: the analysis then averages over the prior. Measured sweeps are analysed
at the maximum of their posterior.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "observe", "say what sweeps can tell about a cell, measured or not", run, _EPILOG)
    parser.add_argument("file", metavar="FILE", help="sweeps or plan: CSV, or HDF5 campaign")
    parser.add_argument("--session", metavar="NAME", help="session to use (default: the first)")
    parser.add_argument(
        "--sigma-nm", type=positive, default=5.0, help="standard deviation supposed for rows of a plan (default: 5)"
    )
    parser.add_argument(
        "--weak-share",
        type=share,
        default=0.5,
        metavar="SHARE",
        help="a parameter is weak if more than this share of its prior variance is left (default: 0.5)",
    )
    parser.add_argument("--profile", default="", metavar="NAME,..", help="parameters whose likelihood is profiled")
    parser.add_argument(
        "--candidates", metavar="SWEEPS", help="further sweeps, not measured yet, whose worth is wanted"
    )
    parser.add_argument("--html", metavar="OUT", type=Path, help="write a page with figures")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.infer.observability.observe import observe
    from fpcal_bayes.io.sweeps import read_sweeps
    from fpcal_bayes.report.observe import print_observability, write_observe_html

    cell = cell_of(options)
    check_output(options.json, options.file, options.candidates)
    check_output(options.html, options.file, options.candidates, options.json)
    sweeps = read_sweeps(options.file, cell, plan=True).of_session(options.session)
    candidates = None if options.candidates is None else read_sweeps(options.candidates, cell, plan=True)
    warm_up(cell)
    result = observe(
        cell,
        sweeps,
        sigma=options.sigma_nm * 1e-3,
        weak_share=options.weak_share,
        profiles=[name for name in options.profile.split(",") if name],
        candidates=candidates,
    )
    title = f"{options.file}, session {sweeps.sessions[0]}"
    print_observability(result, title, console(options))
    warn(result.warnings)
    write_result(options.json, "observe", result.content())
    if options.html is not None:
        write_observe_html(result, title, options.html)
    return 0 if result.identification is None or result.identification.converged else 1
