"""Data files that come with the program."""

import tomllib
from functools import cache
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


@cache
def command_file(name: str) -> dict[str, Any]:
    """What a file of ``data/commands`` states: summary, options and help of a command."""
    return tomllib.loads(data_file(f"commands/{name}.toml").read_text(encoding="utf-8"))
