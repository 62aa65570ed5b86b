"""The tables of a cell that say how it may move: [envelope], and the speed of each joint."""

import math
from typing import Any

from fpcal_bayes.io.validate import Tables
from fpcal_bayes.model.cell.envelope import Envelope

#: Largest tilt that a table may state, in deg.
_MOST_TILT = 80.0
_KEYS = {
    "least_gap_um",
    "fibre_radius_um",
    "mirror_radius_um",
    "max_tilt_deg",
    "max_fringe_rate_hz",
    "together",
    "gap_um",
    "gap_sd_um",
}


def read_envelope(reader: Tables, table: Any, n_joints: int) -> Envelope | None:
    """The envelope that a cell's table states, or None where it states none."""
    if table is None:
        return None
    if not isinstance(table, dict):
        raise reader.error("envelope", "expected a table")
    reader.keys(table, "envelope", _KEYS)

    def number(key: str, low: float = 1e-6, high: float = 1e9, default: float | None = None) -> float:
        return reader.number(table, "envelope", key, low=low, high=high, default=default)

    if ("gap_um" in table) != ("gap_sd_um" in table):
        missing = "gap_sd_um" if "gap_um" in table else "gap_um"
        raise reader.error(f"envelope.{missing}", "expected gap_um and gap_sd_um together: the measured gap and its sd")
    least = number("least_gap_um")
    gap, gap_sd = (number(key) if key in table else None for key in ("gap_um", "gap_sd_um"))
    if gap is not None and gap <= least:
        raise reader.error(
            "envelope.gap_um", f"the gap of {gap:g} um is below least_gap_um = {least:g}: no motion is left"
        )
    return Envelope(
        least_gap=least,
        fibre_radius=number("fibre_radius_um", default=62.5),
        mirror_radius=number("mirror_radius_um"),
        max_tilt=math.radians(number("max_tilt_deg", high=_MOST_TILT)),
        max_fringe_rate=number("max_fringe_rate_hz", default=1000.0),
        together=_groups(reader, table.get("together", []), n_joints),
        gap=gap,
        gap_sd=gap_sd,
    )


def _groups(reader: Tables, stated: Any, n_joints: int) -> tuple[tuple[int, ...], ...]:
    """Groups of joints by position, from names such as ``[["q1", "q2"]]``."""
    names = {f"q{i + 1}": i for i in range(n_joints)}
    groups: list[list[str]] = []
    if isinstance(stated, list) and all(isinstance(group, list) for group in stated):
        groups = stated
    if (stated and not groups) or any(not isinstance(name, str) or name not in names for g in groups for name in g):
        shown = ", ".join(names)
        raise reader.error(
            "envelope.together", f'expected groups of joints such as [["q1", "q2"]], from {shown}; [] for none'
        )
    return tuple(tuple(sorted({names[name] for name in group})) for group in groups if group)
