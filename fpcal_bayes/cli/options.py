"""Options that say what the cell must hold."""

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256, require_writable, write_json
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA, Estimate

if TYPE_CHECKING:
    from fpcal_bayes.decision.forecast import Goal
    from fpcal_bayes.infer.fit.identify import Identification


Commands = Any  # argparse names the type of its subparsers only privately


def add_command(
    commands: Commands, name: str, summary: str, run: Callable[[argparse.Namespace], int], epilog: str = ""
) -> argparse.ArgumentParser:
    """Add a command with the options that every command takes."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--cell", metavar="CELL", default="femto-st", help="cell TOML file, or built-in cell (femto-st)"
    )
    parser.add_argument("--opd", choices=("axis", "perpendicular"), help="path model, in place of the cell's own")
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    return parser


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--json``."""
    parser.add_argument("--json", metavar="OUT", type=Path, help="write the result as JSON")


def add_prior(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--prior``."""
    parser.add_argument(
        "--prior", metavar="ESTIMATE", help="estimate JSON whose values and covariance replace the cell's priors"
    )


def prior_of(options: argparse.Namespace, cell: Cell) -> Estimate | None:
    """The estimate that ``--prior`` names."""
    return None if options.prior is None else read_estimate(options.prior, cell)


def cell_of(options: argparse.Namespace) -> Cell:
    """The cell that the options name."""
    return load_cell(options.cell, opd=options.opd)


def check_output(output: Path | None, *inputs: str | Path | None) -> None:
    """Refuse an output that cannot be written or that is one of the inputs, before any work is done."""
    if output is None:
        return
    for other in inputs:
        if other is not None and Path(other).exists() and output.exists() and output.samefile(other):
            raise InputError(f"{output}: is an input of this command, expected another name for the output")
    require_writable(output)


def with_source(result: "Identification", file: str, session: str) -> "Identification":
    """The result with name and hash of the file, and the session, that it was made from."""
    data = {"file": Path(file).name, "sha256": file_sha256(Path(file)), "session": session}
    return replace(result, estimate=replace(result.estimate, data=data))


def write_result(output: Path | None, command: str, content: dict[str, Any]) -> None:
    """Write the JSON of a command, if it is wanted."""
    if output is not None:
        write_json(output, {"schema": SCHEMA, "command": command, **content})


def warn(warnings: Iterable[str]) -> None:
    """Print warnings, a line each."""
    for warning in warnings:
        print(f"fpcal: warning: {warning}", file=sys.stderr)


def console(options: argparse.Namespace) -> Console:
    """Console for tables: coloured on a terminal, plain and wide when piped, silent with ``--quiet``."""
    terminal = sys.stdout.isatty()
    return _Console(quiet=options.quiet, width=None if terminal else 120, highlight=False)


class _Console(Console):
    """A console that falls silent when the reader of the output is gone; the command still does its work."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def positive(text: str) -> float:
    """Parse an option that must be a finite number above zero."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected a number above zero, found {text!r}")
    return value


def seed(text: str) -> int:
    """Parse a seed: a whole number from 0."""
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, found {text!r}")
    return int(text)


def share(text: str) -> float:
    """Parse an option that must lie between 0 and 1."""
    value = positive(text)
    if value >= 1:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text!r}")
    return value


def count(text: str) -> int:
    """Parse an option that must be a whole number above zero."""
    value = seed(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"expected a whole number above zero, found {text!r}")
    return value


def add_goal(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what the cell must hold."""
    parser.add_argument(
        "--tolerance-nm", type=positive, default=50.0, help="largest peak to peak of a task's error (default: 50)"
    )
    parser.add_argument(
        "--task", metavar="TASK", action="append", help="to be held: circle (default), line-x, line-z, tilt-x, tilt-z, "
        "spin, or PATH.csv; may be given several times"
    )  # fmt: skip
    parser.add_argument("--radius-um", type=positive, default=100.0, help="of the circle (default: 100)")
    parser.add_argument("--level", type=share, default=0.1, help="accepted probability (default: 0.1)")


def goal_of(options: argparse.Namespace) -> "Goal":
    """The goal that the options name."""
    # What the goal stands in needs numpy and scipy: loaded only when a command runs.
    from fpcal_bayes.decision.forecast import Goal

    tasks = tuple(dict.fromkeys(options.task or ["circle"]))
    return Goal(1e-3 * options.tolerance_nm, tasks, options.level, options.radius_um)
