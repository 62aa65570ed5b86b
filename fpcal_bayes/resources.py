"""Data files that come with the program."""

from pathlib import Path

_PACKAGE = Path(__file__).parent


def data_file(name: str) -> Path:
    """Path of a file of the ``data`` folder.

    An installed wheel holds the folder inside the package; a checkout has it beside the package.
    """
    inside = _PACKAGE / "data" / name
    return inside if inside.exists() else _PACKAGE.parent / "data" / name


def built_in_cells() -> list[str]:
    """Names of the cells that come with the program."""
    return ["femto-st"]
