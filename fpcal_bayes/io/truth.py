"""True parameters of a simulated cell as TOML, in the units that a person reads."""

from pathlib import Path
from typing import Any

from fpcal_bayes.core.files import write_text
from fpcal_bayes.io.validate import Tables, read_toml, shown
from fpcal_bayes.measure.truth import Truth, truth_of
from fpcal_bayes.model.cell.cell import Cell


def read_truth(path: str | Path, cell: Cell) -> Truth:
    """Read a truth (um, deg, ppm) of ``[parameters]``, or ``[[epoch]]`` tables with ``time_h``; the rest is nominal."""
    return read_toml(Path(path), lambda table: _truth(Tables(path, shown), table, cell))


def _truth(tables: Tables, table: dict[str, Any], cell: Cell) -> Truth:
    tables.keys(table, "", ("parameters", "epoch"), unknown="unknown")
    if ("parameters" in table) == ("epoch" in table):
        raise tables.error("parameters", "expected either a table [parameters] or several [[epoch]]")
    epochs = _epochs(tables, table, cell) if "epoch" in table else [(0.0, _values(tables, table, "", cell))]
    return truth_of(cell, epochs, str(tables.file))


def _epochs(tables: Tables, table: dict[str, Any], cell: Cell) -> list[tuple[float, dict[str, float]]]:
    epochs: list[tuple[float, dict[str, float]]] = []
    if not isinstance(table["epoch"], list) or not table["epoch"]:
        raise tables.error("epoch", "expected one or more tables [[epoch]]")
    for number, entry in enumerate(table["epoch"], 1):
        place = f"epoch {number}"
        if not isinstance(entry, dict):
            raise tables.error(place, "expected a table")
        tables.keys(entry, place, ("time_h", "parameters"), unknown="unknown")
        time = tables.number(entry, place, "time_h")
        if epochs and time <= epochs[-1][0]:
            raise tables.error(f"{place}.time_h", f"expected more than {epochs[-1][0]:g} h, found {time:g}")
        epochs.append((time, _values(tables, entry, place, cell)))
    return epochs


def _values(tables: Tables, parent: dict[str, Any], place: str, cell: Cell) -> dict[str, float]:
    table = tables.table(parent, place, "parameters", "expected a table of values by parameter name")
    place = f"{place}.parameters" if place else "parameters"
    tables.keys(table, place, cell.parameters.names, named=cell.free.names, unknown="unknown")
    return {name: tables.number(table, place, name) for name in table}


def write_truth(path: str | Path, truth: Truth) -> None:
    """Write a truth to a TOML file, whole or not at all: a table ``[[epoch]]`` for each of its times."""
    record = truth.record()
    lines = []
    for time_h, values in zip(record.times_h.tolist(), record.values.tolist(), strict=True):
        lines += ["[[epoch]]", f"time_h = {time_h!r}", "[epoch.parameters]"]
        pairs = zip(record.names, values, record.units, strict=True)
        lines += [f"{name} = {value!r}  # {unit}" for name, value, unit in pairs] + [""]
    write_text(Path(path), "\n".join(lines))
