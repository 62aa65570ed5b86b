"""Write a truth as the TOML that `truth.read_truth` reads."""

import math
import tomllib
from pathlib import Path
from typing import Any

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import read_text, require_line_end, write_text
from fpcal_bayes.measure.truth import Truth, _truth
from fpcal_bayes.model.cell.cell import Cell


def read_truth(path: str | Path, cell: Cell) -> Truth:
    """Read a truth from a TOML file.

    Parameters
    ----------
    path
        Either a table ``[parameters]`` of values by name, which hold at all times, or several ``[[epoch]]``, each
        with ``time_h`` and a table ``[epoch.parameters]``. Values in um, deg or ppm; in each of these tables what is
        not named is nominal.

    Raises
    ------
    InputError
        If the file is missing, is not TOML, or holds anything else; the message names the key.
    """
    path = Path(path)
    try:
        text = read_text(path)
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not a TOML file: {error}") from error
    except (RecursionError, ValueError) as error:
        # A ValueError that is not an InputError: a number with thousands of digits.
        raise error if isinstance(error, InputError) else InputError(f"{path}: not a truth ({error})") from error
    _check_keys(path, table, "", {"parameters", "epoch"})
    if ("parameters" in table) == ("epoch" in table):
        raise InputError(f"{path}: key parameters: expected either a table [parameters] or several [[epoch]]")
    if "parameters" in table:
        epochs = [(0.0, _values(path, table["parameters"], "parameters", cell))]
    else:
        epochs = _epochs(path, table, cell)
    if text[-1:].isdigit():
        require_line_end(path, text)
    return _truth(cell, epochs, str(path))


def _epochs(path: Path, table: dict[str, Any], cell: Cell) -> list[tuple[float, dict[str, float]]]:
    """Time in hours and values of each epoch."""
    epochs: list[tuple[float, dict[str, float]]] = []
    if not isinstance(table["epoch"], list) or not table["epoch"]:
        raise InputError(f"{path}: key epoch: expected one or more tables [[epoch]]")
    for number, entry in enumerate(table["epoch"], 1):
        place = f"epoch {number}"
        if not isinstance(entry, dict):
            raise InputError(f"{path}: key {place}: expected a table")
        _check_keys(path, entry, place, {"time_h", "parameters"})
        time = _number(path, entry.get("time_h"), f"{place}.time_h")
        if epochs and time <= epochs[-1][0]:
            raise InputError(f"{path}: key {place}.time_h: expected more than {epochs[-1][0]:g} h, found {time:g}")
        epochs.append((time, _values(path, entry.get("parameters"), f"{place}.parameters", cell)))
    return epochs


def _values(path: Path, table: Any, place: str, cell: Cell) -> dict[str, float]:
    if not isinstance(table, dict):
        raise InputError(f"{path}: key {place}: expected a table of values by parameter name")
    _check_keys(path, table, place, set(cell.parameters.names), shown=set(cell.free.names))
    return {name: _number(path, value, f"{place}.{name}") for name, value in table.items()}


def _check_keys(path: Path, table: dict[str, Any], place: str, known: set[str], shown: set[str] | None = None) -> None:
    for key in table:
        if key not in known:
            at = f"{place}.{key}" if place else key
            raise InputError(f"{path}: key {at}: unknown, expected one of {', '.join(sorted(shown or known))}")


def _number(path: Path, value: Any, place: str) -> float:
    try:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:
        pass
    raise InputError(f"{path}: key {place}: expected a finite number, found {str(value)[:40]!r}")


def write_truth(path: str | Path, truth: Truth) -> None:
    """Write a truth to a TOML file, whole or not at all: a table ``[[epoch]]`` for each of its times.

    Parameters
    ----------
    path
        Replaced if it exists.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    record = truth.record()
    lines = []
    for time_h, values in zip(record.times_h.tolist(), record.values.tolist(), strict=True):
        lines += ["[[epoch]]", f"time_h = {time_h!r}", "[epoch.parameters]"]
        pairs = zip(record.names, values, record.units, strict=True)
        lines += [f"{name} = {value!r}  # {unit}" for name, value, unit in pairs] + [""]
    write_text(Path(path), "\n".join(lines))
