"""The [[task]] tables of a cell."""

import math
from typing import Any

from fpcal_bayes.io.validate import Tables
from fpcal_bayes.model.cell.own_tasks import OWN_KINDS, OwnTask

#: Keys of a tolerance: name of the degree of freedom and um or rad per unit.
_TOLERANCES = {
    "beam_nm": ("beam", 1e-3),
    "x_nm": ("x", 1e-3),
    "z_nm": ("z", 1e-3),
    "rx_deg": ("rx", math.radians(1.0)),
    "ry_deg": ("ry", math.radians(1.0)),
    "rz_deg": ("rz", math.radians(1.0)),
}
#: Names that mean another thing on the command line.
_TAKEN = ("circle", "line-x", "line-z", "tilt-x", "tilt-z", "spin", "all")


def read_tasks(reader: Tables, tables: Any) -> tuple[OwnTask, ...]:
    """The tasks that a cell's tables state."""
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise reader.error("task", "expected one [[task]] table for each task")
    found: list[OwnTask] = []
    for number, table in enumerate(tables, 1):
        task = _task(reader, table, f"task {number}")
        if task.name in _TAKEN or task.name.lower().endswith(".csv") or task.name in [other.name for other in found]:
            raise reader.error(f"task {number}.name", f"{task.name!r:.40} is taken, expected another name")
        found.append(task)
    return tuple(found)


def _task(reader: Tables, table: dict[str, Any], place: str) -> OwnTask:
    kind, name = table.get("kind"), table.get("name")
    if kind not in OWN_KINDS:
        raise reader.error(f"{place}.kind", f"expected one of {', '.join(OWN_KINDS)}, found {kind!r:.40}")
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name.strip()) <= 100:
        raise reader.error(f"{place}.name", "expected a line of text in quotes")
    unit = "deg" if OWN_KINDS[kind] >= 3 else "um"
    size = "radius_um" if kind == "circle" else f"range_{unit}"
    reader.keys(table, place, {"name", "kind", size, "centre_um", "tolerance"})
    scale = math.radians(1.0) if unit == "deg" else 1.0
    radius, low, high = 0.0, 0.0, 0.0
    if kind == "circle":
        radius = reader.number(table, place, size, low=1e-6, high=1e6)
    else:
        low, high = (end * scale for end in _numbers(reader, table, place, size, 2))
        if not low < high:
            raise reader.error(f"{place}.{size}", "expected low < high")
        if unit == "deg" and max(-low, high) > math.pi:
            raise reader.error(f"{place}.{size}", "expected angles from -180 to 180")
    x, y, z = _numbers(reader, table, place, "centre_um", 3) if "centre_um" in table else (0.0, 0.0, 0.0)
    tolerance = table.get("tolerance", {})
    if not isinstance(tolerance, dict):
        raise reader.error(f"{place}.tolerance", "expected a table such as { beam_nm = 50 }")
    reader.keys(tolerance, f"{place}.tolerance", set(_TOLERANCES))
    known = {
        freedom: per * reader.number(tolerance, f"{place}.tolerance", key, low=1e-9)
        for key, (freedom, per) in _TOLERANCES.items()
        if key in tolerance
    }
    return OwnTask(name, kind, radius, low, high, (x, y, z), known)


def _numbers(reader: Tables, table: dict[str, Any], place: str, key: str, n: int) -> list[float]:
    values = table.get(key)
    if not isinstance(values, list) or len(values) != n:
        raise reader.error(f"{place}.{key}", f"expected {n} numbers")
    named = {str(i): value for i, value in enumerate(values)}
    return [reader.number(named, f"{place}.{key}", str(i)) for i in range(n)]
