"""What all commands do with their options and with what they found."""

import argparse
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_writable, write_json
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA
from fpcal_bayes.model.trust import Trust


def cell_of(options: argparse.Namespace) -> Cell:
    """The cell that the options name."""
    return load_cell(options.cell, opd=options.opd, mechanics=options.mechanics)


def check_output(output: Path | None, *inputs: str | Path | None) -> None:
    """Refuse an output that cannot be written or that is one of the inputs, before any work is done."""
    if output is None:
        return
    for other in inputs:
        if other is not None and Path(other).exists() and output.exists() and output.samefile(other):
            raise InputError(f"{output}: is an input of this command, expected another name for the output")
    require_writable(output)


def check_suffix(output: Path | None, *suffixes: str) -> None:
    """Refuse an output whose name ends otherwise."""
    if output is not None and output.suffix.lower() not in suffixes:
        ends = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise InputError(f"{output}: expected a file name that ends in {ends}")


def write_result(output: Path | None, command: str, content: dict[str, Any], trust: Trust | None = None) -> None:
    """Write the JSON of a command, if it is wanted; `trust` where the content is not that of an estimate."""
    if output is not None:
        said = {} if trust is None else {"trust": trust.content()}
        write_json(output, {"schema": SCHEMA, "command": command, **content, **said})


def warn(warnings: Iterable[str]) -> None:
    """Print warnings, a line each."""
    for warning in warnings:
        print(f"fpcal: warning: {warning}", file=sys.stderr)


class Output(Console):
    """A console that falls silent when the reader of the output is gone; the command still does its work."""

    def say(self, text: str) -> None:
        """Print a sentence as it is, in one line when piped."""
        self.print(text, markup=False, soft_wrap=True)

    def on_broken_pipe(self) -> None:
        """Go on in silence."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def console(options: argparse.Namespace) -> Output:
    """Console for tables: coloured on a terminal, plain and wide when piped, silent with ``--quiet``."""
    terminal = sys.stdout.isatty()
    return Output(quiet=options.quiet, width=None if terminal else 120, highlight=False)
