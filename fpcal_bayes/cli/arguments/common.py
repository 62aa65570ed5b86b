"""What the options of several commands have in common; nothing here is slow to import."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

Commands = tuple[tuple[str, str, Callable[[argparse.ArgumentParser], None]], ...]


#: Commands whose result is another file, or none.
_WITHOUT_JSON = ("simulate", "export", "import", "keep", "measure", "rig", "serve", "week")
#: Error motions of the mechanism where the option is not given.
MECHANICS = "stated"


class Folder(Path):
    """A folder that a command fills."""


def add_command(commands: Any, name: str, summary: str, options: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add a command with the options that every command takes, and its own."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--cell", metavar="CELL", default="femto-st", help="cell TOML file, or built-in cell (femto-st)")
    add("--opd", choices=("axis", "perpendicular"), help="path model, in place of the cell's own")
    motions = "error motions as the cell states them (default), or a mechanism that is perfect"
    add("--mechanics", choices=("stated", "none"), default=MECHANICS, help=motions)
    add("--quiet", action="store_true", help="print warnings and errors only")
    options(parser)
    if name not in _WITHOUT_JSON:
        add("--json", metavar="OUT", type=Path, help="write the result as JSON")


def add_prior(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--prior``."""
    same = "estimate JSON of the same, unchanged cell: its sweeps count as well"
    parser.add_argument("--prior", metavar="ESTIMATE", help=same)


def add_goal(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what the cell must hold."""
    add = parser.add_argument
    add("--tolerance-nm", type=positive, help="largest peak to peak of a task's error (default: 50, or the task's own)")
    held = "to be held, may be repeated: circle (default), line-x|z, tilt-x|z, spin, the cell's own, or PATH.csv"
    add("--task", metavar="TASK", action="append", help=held)
    add("--radius-um", type=positive, metavar="R", help="of the circle (default: 100, or what the limits allow)")
    add("--level", type=share, default=0.1, help="accepted probability (default: 0.1)")
    add_compensation(parser)


def add_costs(parser: argparse.ArgumentParser) -> None:
    """Add what measuring costs and how far ahead is looked."""
    add = parser.add_argument
    add("--horizon-h", type=positive, default=24.0, help="how far to look ahead (default: 24)")
    add("--minutes-per-sweep", type=positive, default=2.0, help="default: 2")
    add("--minutes-per-session", type=positive, help="spent once a session (default: none)")
    add("--most-sweeps", type=count, default=6, help="of a session with few sweeps (default: 6)")
    add("--least-sweeps", type=count, default=1, help="likewise: 2 if drift sizes are not to be trusted (default: 1)")
    looks = "longest time between sessions that can show a change of the robot itself (default: 24)"
    add("--diagnose-every-h", type=positive, default=24.0, metavar="H", help=looks)
    add("--sigma-nm", type=positive, help="of the sweeps to come (default: the campaign's median)")


def add_task_options(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """Add the options that choose a task."""
    add = parser.add_argument
    add("--task", metavar="TASK", required=required, default="all", help="task by name, or a path CSV (see below)")
    add("--radius-um", type=positive, metavar="R", help="of the circle (default: 100, or what the limits allow)")
    add("--points", type=count, metavar="N", help="points of the path (default: 31 with mechanics, else 61)")
    add_compensation(parser)


def add_compensation(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--no-compensation``."""
    alone = "drive as the geometry alone says (default: make up for known error motions, where that gains)"
    parser.add_argument("--no-compensation", dest="compensate", action="store_false", help=alone)


def positive(text: str) -> float:
    """Parse an option that must be a finite number above zero."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1e-9 <= value <= 1e9:
        limit = ", 1e-9 to 1e9" if value > 0 else ""
        raise argparse.ArgumentTypeError(f"expected a number above zero{limit}, found {text[:40]!r}")
    return value


def columns(text: str) -> dict[str, str]:
    """Parse an option that says what the files of traces call their columns."""
    pairs = [part.partition("=") for part in text.split(",")]
    keys = {"t": "t_s", "joint": "joint", "irradiance": "irradiance_v"}
    if not all(key.strip() in keys and name.strip() for key, _, name in pairs):
        raise argparse.ArgumentTypeError(f"expected t=NAME,joint=NAME,irradiance=NAME or some of these, found {text!r}")
    return {keys[key.strip()]: name.strip() for key, _, name in pairs}


def share(text: str) -> float:
    """Parse an option that must lie between 0 and 1."""
    value = positive(text)
    if value >= 1:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text!r}")
    return value


def seed(text: str) -> int:
    """Parse a seed: a whole number from 0."""
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, found {text!r}")
    return int(text)


def count(text: str) -> int:
    """Parse an option that must be a whole number above zero."""
    value = seed(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"expected a whole number above zero, found {text!r}")
    return value
