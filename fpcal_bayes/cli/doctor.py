"""``fpcal doctor``: what is wrong with a campaign, and what to do about it."""

import argparse

from fpcal_bayes.cli.options import Commands, add_command, add_json, cell_of, check_output, console, write_result
from fpcal_bayes.infer.fit.kernels import warm_up

_EPILOG = """\
problem: results are wrong or cannot be had; doubt: they may be; note: good to know. Each finding comes with what to do.
Looks at times and order of the sessions, rows measured twice, signs, joints that never move, poses at limits, what the
calibration cannot see, the fit of each session (slipped counts, outliers, path model, size of the noise), and what
changed from session to session. The exit status is 0 whatever is found; 2 if the file cannot be read.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "doctor", "say what is wrong with a campaign, and what to do about it", run, _EPILOG)
    parser.add_argument("file", metavar="FILE", help="sweeps or plan: CSV, or HDF5 campaign")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from rich.markup import escape

    from fpcal_bayes.analysis.doctor import examine
    from fpcal_bayes.io.sweeps import read_sweeps

    cell = cell_of(options)
    check_output(options.json, options.file)
    sweeps = read_sweeps(options.file, cell, plan=True)
    warm_up(cell)
    findings = examine(sweeps, cell)
    out = console(options)
    styles = {"problem": "red", "doubt": "yellow", "note": "dim"}
    for finding in findings:
        where = f" in session {finding.where}" if finding.where else ""
        style, kind = styles[finding.severity], escape(finding.kind + where)
        out.print(f"[{style}]{finding.severity}[/] ({kind}): {escape(finding.what)}", soft_wrap=True)
        out.print(f"    what to do: {finding.remedy}", markup=False, soft_wrap=True)
    counts = [f"{sum(f.severity == severity for f in findings)} {severity}s" for severity in styles]
    rows = f"{len(sweeps)} rows, {len(sweeps.sessions)} sessions"
    out.print(f"{options.file}: {rows}: {', '.join(counts)}", markup=False, soft_wrap=True)
    write_result(options.json, "doctor", {"findings": [finding.content() for finding in findings]})
    return 0
