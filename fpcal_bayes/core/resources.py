"""Data files that come with the program."""

import tomllib
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parents[1]


def data_file(name: str) -> Path:
    """Path of a file of the ``data`` folder, inside an installed package or beside it in a checkout."""
    inside = _PACKAGE / "data" / name
    return inside if inside.exists() else _PACKAGE.parent / "data" / name


def built_in_cells() -> list[str]:
    """Names of the cells that come with the program."""
    return ["femto-st", "three-beams"]


def paper_tables() -> dict[str, Any]:
    """Tables of Bettahar et al., as ``data/bettahar.toml`` holds them, in um and deg."""
    return tomllib.loads(data_file("bettahar.toml").read_text(encoding="utf-8"))


def help_text(command: str) -> str | None:
    """What stands below the options in the help of a command, or of ``fpcal`` itself."""
    found: str | None = tomllib.loads(data_file("help.toml").read_text(encoding="utf-8")).get(command)
    return found
