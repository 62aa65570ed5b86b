"""What all commands do with their options and with what they found."""

import argparse
import contextlib
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from fpcal_bayes.cli.arguments import Folder
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_writable, write_json
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA
from fpcal_bayes.model.trust import Trust
from fpcal_bayes.report.table import ANY_WIDTH


def cell_of(options: argparse.Namespace) -> Cell:
    """The cell that the options name."""
    return load_cell(options.cell, opd=options.opd, mechanics=options.mechanics)


def about(cell: Cell) -> dict[str, Any]:
    """The cell in the JSON of a result that is no estimate."""
    return {"cell": {"name": cell.name, "sha256": cell.sha256}}


def check_outputs(options: argparse.Namespace) -> None:
    """Refuse outputs, paths but for folders, that cannot be written, or that are inputs (texts) or one another."""
    given = [each for value in vars(options).values() for each in (value if isinstance(value, list) else [value])]
    outputs = [value for value in given if isinstance(value, Path) and not isinstance(value, Folder)]
    for i, output in enumerate(outputs):
        target = require_writable(output)
        if target.exists() and not target.is_file():
            continue
        if any(os.path.realpath(target) == os.path.realpath(other) for other in outputs[:i]):
            raise InputError(f"{output}: is another output too, expected two names")
        if any(_is_same(target, value) for value in given if isinstance(value, str)):
            raise InputError(f"{output}: is an input of this command, expected another name for the output")


def _is_same(target: Path, text: str) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return target.samefile(text)
    return False


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
    """A console for tables and sentences."""

    def say(self, text: str) -> None:
        """Print a sentence as it is, in one line when piped."""
        self.print(text, markup=False, soft_wrap=True)


def console(options: argparse.Namespace) -> Output:
    """Console for tables: coloured on a terminal, plain and as wide as these when piped, silent with ``--quiet``."""
    return Output(quiet=options.quiet, width=None if sys.stdout.isatty() else ANY_WIDTH, highlight=False)


def show(options: argparse.Namespace, parts: Iterable[object], warnings: Iterable[str] = ()) -> None:
    """Print tables, sentences as they are, and then warnings."""
    out = console(options)
    for part in parts:
        out.say(part) if isinstance(part, str) else out.print(part)
    warn(warnings)
