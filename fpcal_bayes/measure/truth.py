"""The true parameters of a simulated cell through time."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.files import read_text, require_line_end
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.resources import data_file

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TruthRecord:
    """A truth as files hold it, in the units a person reads.

    Attributes
    ----------
    names, units
        Of the parameters, n of each.
    times_h
        Epochs in hours, shape (t,).
    values
        In `units`, shape (t, n).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    times_h: Floats
    values: Floats

    def check(self, cell: Cell, place: str) -> None:
        """Raise `InputError` unless the record is one of parameters of `cell`, at epochs in order.

        Parameters
        ----------
        place
            Where the record comes from, for the message.
        """
        shape = (len(self.times_h), len(self.names))
        if self.values.shape != shape or len(self.units) != len(self.names) or not self.names:
            raise InputError(f"{place}: expected as many units as names, and values of shape {shape}")
        if len(set(self.names)) != len(self.names):
            raise InputError(f"{place}: a parameter name stands twice")
        for name, unit in zip(self.names, self.units, strict=True):
            try:
                expected = cell.parameters[name].unit
            except InputError as error:
                raise InputError(f"{place}: {error}") from error
            if unit != expected:
                raise InputError(f"{place}: parameter {name}: expected the unit {expected}, found {unit!r:.40}")
        if not (np.isfinite(self.times_h).all() and np.isfinite(self.values).all()):
            raise InputError(f"{place}: expected finite numbers")
        if len(self.times_h) == 0 or (np.diff(self.times_h) <= 0).any():
            raise InputError(f"{place}: expected epochs in the order of time_h")


@dataclass(frozen=True)
class Truth:
    """True parameter values at epochs: linear between two epochs, constant before the first and after the last.

    Attributes
    ----------
    parameters
        The parameters that have a value; every other one of the cell is nominal.
    times_h
        Epochs in hours, increasing, shape (t,).
    values
        In um and rad, shape (t, n).
    """

    parameters: ParameterSet
    times_h: Floats
    values: Floats

    def at(self, time_h: ArrayLike) -> Floats:
        """Values in um and rad at one time, shape (n,), or at m times, shape (m, n)."""
        times = np.asarray(time_h, dtype=float)
        columns = [np.interp(times, self.times_h, column) for column in self.values.T]
        return np.stack(columns, axis=-1)

    def record(self) -> TruthRecord:
        """The same truth as files hold it."""
        units = tuple(p.unit for p in self.parameters)
        return TruthRecord(self.parameters.names, units, self.times_h, self.parameters.to_shown(self.values))

    @classmethod
    def of_record(cls, record: TruthRecord, cell: Cell, place: str = "truth") -> "Truth":
        """The truth that a record of `cell` tells; `InputError` if it is not one of this cell."""
        record.check(cell, place)
        parameters = ParameterSet(cell.parameters[name] for name in record.names)
        return cls(parameters, record.times_h, parameters.to_internal(record.values))


def paper_tables() -> dict[str, Any]:
    """Tables of Bettahar et al., as ``data/bettahar.toml`` holds them, in um and deg."""
    return tomllib.loads(data_file("bettahar.toml").read_text(encoding="utf-8"))


def paper_truth(cell: Cell) -> Truth:
    """What the paper's full identifications found, as the truth of a simulated cell.

    An identification of the extrinsic parameters alone, with stale intrinsic ones, is no truth and is left out.

    Raises
    ------
    InputError
        If the cell lacks one of the parameters.
    """
    full = [entry for entry in paper_tables()["identification"] if entry["kind"] == "full"]
    # Later tables list what they changed.
    first = full[0]["intrinsic"]
    epochs = [(24.0 * entry["day"], first | entry["intrinsic"] | entry["extrinsic"]) for entry in full]
    return _truth(cell, epochs, "the paper's truth")


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


def _truth(cell: Cell, epochs: list[tuple[float, dict[str, float]]], place: str) -> Truth:
    named = {name for _, values in epochs for name in values}
    for name in sorted(named):
        if name not in cell.parameters.names:
            raise InputError(f"{place}: cell {cell.name!r} has no parameter {name}")
    free = set(cell.free.names)
    parameters = ParameterSet(p for p in cell.parameters if p.name in free | named)
    values = np.array([parameters.from_mapping(shown) for _, shown in epochs])
    return Truth(parameters, np.array([time for time, _ in epochs]), values)


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
