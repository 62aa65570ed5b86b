"""What commands share: options, announcements, output."""

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from fpcal_bayes.errors import InputError
from fpcal_bayes.files import file_sha256, require_writable, write_json
from fpcal_bayes.model.cell import Cell, load_cell
from fpcal_bayes.model.estimate import SCHEMA, Estimate, read_estimate

if TYPE_CHECKING:
    from fpcal_bayes.infer.identify import Identification

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


def warm_up(cell: Cell) -> None:
    """Load the kernels, so that times do not count it; say so if they have to be compiled first."""
    from fpcal_bayes.infer.kernel_whitening import whiten_groups
    from fpcal_bayes.model.cavity import CavityModel
    from fpcal_bayes.model.compiled import needs_compilation
    from fpcal_bayes.model.kernel import batch_lengths
    from fpcal_bayes.model.kernel_jacobian import batch_jacobians

    if needs_compilation(batch_lengths, batch_jacobians, whiten_groups):
        print("fpcal: compiling the kernels; this happens once and takes about 20 s", file=sys.stderr)
    model, home = CavityModel.of(cell), np.zeros((1, len(cell.joints)))
    model.predict(model.free.nominal, model.pose_rows(home))
    model.predict_with_jacobian(model.free.nominal, model.pose_rows(home))
    one = np.ones((1, 1, 1))
    whiten_groups(one, np.zeros((1, 1), dtype=np.int64), one[0], one, one, one[0])


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
