"""Options of the commands, as ``data/commands`` states them; nothing here is slow to import."""

import argparse
import math
from pathlib import Path
from typing import Any

from fpcal_bayes.core.resources import command_file

#: In the order of the work.
COMMANDS = (
    *("cell", "simulate", "ingest", "trace", "doctor", "observe"),
    *("identify", "sample", "compare", "verify", "task-error", "control", "check", "certificate"),
    *("plan", "track", "decide", "append", "keep", "export", "import", "measure", "rig", "serve"),
    *("report", "week", "study"),
)
#: Commands whose result is another file, or none.
_WITHOUT_JSON = ("simulate", "export", "import", "keep", "measure", "rig", "serve", "week")
#: Error motions of the mechanism where the option is not given.
MECHANICS = "stated"


class Folder(Path):
    """A folder that a command fills."""


def add_command(commands: Any, name: str) -> None:
    """Add a command with the options that every command takes, and its own."""
    stated = command_file(name)
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=stated["summary"],
        description=stated["summary"][0].upper() + stated["summary"][1:] + ".",
        epilog=stated.get("help"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--cell", metavar="CELL", default="femto-st", help="cell TOML file, or built-in cell (femto-st)")
    add("--opd", choices=("axis", "perpendicular"), help="path model, in place of the cell's own")
    motions = "error motions as the cell states them (default), or a mechanism that is perfect"
    add("--mechanics", choices=("stated", "none"), default=MECHANICS, help=motions)
    add("--quiet", action="store_true", help="print warnings and errors only")
    exclusive = stated.get("exclusive", ())
    group = parser.add_mutually_exclusive_group() if exclusive else parser
    for option, settings in stated["options"].items():
        several = command_file("shared")[option[1:]] if option.startswith("+") else {option: settings}
        for names, own in several.items():
            (group if names in exclusive else parser).add_argument(*names.split(), **_understood(own))
    if name not in _WITHOUT_JSON:
        add("--json", metavar="OUT", type=Path, help="write the result as JSON")


def _understood(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of an option as argparse takes them: parsers and the switch with two names in place of their words."""
    made = dict(settings)
    if "type" in made:
        made["type"] = _TYPES[made["type"]]
    if made.get("action") == "boolean":
        made["action"] = argparse.BooleanOptionalAction
    return made


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


#: What the files of commands call the parsers of texts.
_TYPES: dict[str, Any] = {each.__name__: each for each in (positive, columns, share, seed, count, float)}
_TYPES |= {"path": Path, "folder": Folder}
