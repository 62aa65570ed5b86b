"""The ``fpcal`` program: which commands there are, and what every one of them does about errors."""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from fpcal_bayes import __version__
from fpcal_bayes.cli import compare, control, decide, identify, observe, plan, sample, simulate, task_error, track, week
from fpcal_bayes.errors import InputError

_DESCRIPTION = """\
Calibrate a micro- or nano-positioning robot from one-dimensional Fabry-Perot measurements.

A first tour, on a simulated cell:
  fpcal simulate -o sweeps.csv            measure the paper's 69 sweeps
  fpcal observe sweeps.csv                what these sweeps can tell
  fpcal identify sweeps.csv               find the geometry, and how far to trust it
  fpcal sample sweeps.csv -o posterior.nc the whole posterior, by emcee
  fpcal week -o week                      the paper's whole week, with a report

Lengths are in um, angles in deg. FILE is a CSV of sweeps or an HDF5 campaign (.h5).
Exit status: 0 done; 1 the result is not to be used (did not converge); 2 the input cannot be used.
"""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like every other error of the program."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InputError(f"{message} (see {self.prog} --help)")


def make_parser() -> Parser:
    """Build the parser of all commands."""
    parser = Parser(
        prog="fpcal", description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"fpcal {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for module in (simulate, observe, identify, sample, compare, control, task_error, plan, track, decide, week):
        module.add_parser(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments
        Without the program's name; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 ran but did not converge, 2 bad usage or input, 130 interrupted.
    """
    try:
        options = make_parser().parse_args(arguments)
        status: int = options.run(options)
        sys.stdout.flush()
    except InputError as error:
        print(f"fpcal: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("fpcal: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of the output is gone; Python would complain about it once more on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return status
