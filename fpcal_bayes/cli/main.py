"""The ``fpcal`` program: which commands there are, and what every one of them does about errors."""

import argparse
import gc
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from keyword import iskeyword
from typing import Any, NoReturn

from fpcal_bayes.cli.arguments import identify, keep, live, measure
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.version import __version__

#: In the order of the work.
_COMMANDS = (
    measure.cell,
    measure.simulate,
    measure.ingest,
    measure.doctor,
    measure.observe,
    identify.identify,
    identify.sample,
    identify.compare,
    identify.task_error,
    identify.control,
    identify.check,
    keep.plan,
    keep.track,
    keep.decide,
    keep.append,
    keep.export,
    keep.import_,
    live.measure,
    live.rig,
    keep.report,
    keep.week,
    keep.study,
)

_DESCRIPTION = """\
Calibrate a micro- or nano-positioning robot from one-dimensional Fabry-Perot measurements.

The way through, here on a simulated cell:
  measure    fpcal simulate -o sweeps.csv                  the paper's 69 sweeps; your traces: fpcal ingest
  look       fpcal doctor sweeps.csv                       what is wrong, and what to do about it
             fpcal observe sweeps.csv                      what these sweeps can tell
  identify   fpcal identify sweeps.csv --json day0.json    the geometry, and how far to trust it
             fpcal sample sweeps.csv -o posterior.nc       the whole posterior, by emcee
  use        fpcal task-error day0.json --tolerance-nm 50  how many nanometres each task will be off
             fpcal control --estimate day0.json --task circle -o joints.csv
  keep       fpcal track campaign.h5                       the drift from session to session
             fpcal decide campaign.h5 --tolerance-nm 50    hold, re-identify or recalibrate
             fpcal report campaign.h5 -o report.html       all of it on one page
  or         fpcal week -o week                            the paper's whole week at once
"""

_EPILOG = """\
Lengths are in um, angles in deg. FILE is a CSV of sweeps or an HDF5 campaign (.h5). More: fpcal COMMAND --help.
Tables are coloured on a terminal only; NO_COLOR=1 turns that off. Warnings and errors go to stderr.
Exit status: 0 done; 1 the result is not to be used (did not converge); 2 the input cannot be used; 130 interrupted.
"""


class _Completion(argparse.Action):
    """Print a script that completes commands and options in a shell."""

    def __call__(self, parser: argparse.ArgumentParser, *parts: Any) -> NoReturn:
        print(_load("shtab").complete(parser, shell=parts[1]))
        parser.exit(0)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like every other error of the program."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InputError(f"{message} (see {self.prog} --help)")


def make_parser() -> Parser:
    """Build the parser of all commands."""
    parser = Parser(
        prog="fpcal",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"fpcal {__version__}")
    parser.add_argument(
        "--print-completion",
        action=_Completion,
        choices=("bash", "zsh", "tcsh"),
        help="print a script that completes commands and options in this shell",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for add in _COMMANDS:
        add(commands)
    return parser


def _load(name: str) -> Any:
    """The only import that waits: what a command runs takes many times as long to import as the options of all."""
    # Modules live as long as the process: looking for garbage among their objects takes a fifth of the time.
    gc.disable()
    try:
        return import_module(name)
    finally:
        gc.enable()


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
        name = options.command.replace("-", "_")
        command = _load(f"fpcal_bayes.cli.{name}{'_' * iskeyword(name)}")
        if arguments is None:
            gc.freeze()
        status: int = command.run(options)
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
    finally:
        if arguments is None:
            # The process ends, and its memory with it: looking for garbage once more takes as long as all of numpy.
            gc.freeze()
    return status
