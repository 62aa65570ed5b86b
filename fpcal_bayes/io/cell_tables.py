"""Single tables of a cell: [[beam]], [envelope], [[task]], and sizes of error motions in the words of data sheets."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from fpcal_bayes.io.validate import Tables, literal
from fpcal_bayes.model.cell.beams import AT, PATHS, Beam, OpticalAxis, Target
from fpcal_bayes.model.cell.cell import extrinsics_of
from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics
from fpcal_bayes.model.cell.joints import Joint
from fpcal_bayes.model.cell.tables import OWN_KINDS, Envelope, OwnTask

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_BEAM_KEYS = ("name", "shares", "target", "opd", "optical_axis", "wavelength_nm", "extrinsic")


def read_beams(
    reader: Tables, tables: object, first: Mapping[str, Any], extrinsic: dict[str, Any] | None
) -> tuple[list[Beam], list[tuple[str, dict[str, Any], str]]]:
    """The beams of a cell, by default as `first`; place of each table of parameters, that table, names' suffix."""
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise reader.error("beam", f"expected one [[beam]] table for each beam, found {literal(tables)}")
    made: dict[str, Beam] = {}
    parts: list[tuple[str, dict[str, Any], str]] = []
    for number, table in enumerate(tables or [{}], 1):
        place = f"beam {number}" if tables else "extrinsic"
        reader.keys(table, place, _BEAM_KEYS)
        name = reader.text(table, place, "name") if tables else ""
        if tables and (not _NAME.fullmatch(name) or name in made):
            what = f"expected another name for each beam, of letters, digits and -_., found {literal(name)}"
            raise reader.error(f"{place}.name", what)
        other = _shared(reader, table, place, made) if "shares" in table else None
        known = first if other is None else {key: getattr(other, key) for key in first}
        target = reader.choice(table, place, "target", get_args(Target), known["target"])
        opd = reader.choice(table, place, "opd", PATHS[target], known["opd"] if known["opd"] in PATHS[target] else None)
        axis = reader.choice(table, place, "optical_axis", get_args(OpticalAxis), known["optical_axis"])
        shown = 1e3 * known["wavelength"]
        wave = reader.number(table, place, "wavelength_nm", low=1e-3, high=20_000.0, default=shown) * 1e-3
        wave = wave if "wavelength_nm" in table else known["wavelength"]

        own = reader.optional(table, place, "extrinsic")
        at, suffix = f"{place}.extrinsic", f"{AT}{name}" if made else ""
        if not made and extrinsic is not None:
            if own:
                raise reader.error(at, "expected no other table [extrinsic] beside it, which is the first beam's")
            own, at = extrinsic, "extrinsic"
        names = extrinsics_of(target)
        reader.keys(own, at, {"drift", *names})
        # What stands where on another kind of target is not the same thing.
        shared = dict(zip(extrinsics_of(other.target), other.parameters, strict=True)) if other else {}
        both = [stem for stem in names if not stem.endswith("_et") or (other is not None and other.target == target)]
        parameters = tuple(
            shared[stem] if other is not None and stem not in own and stem in both else f"{stem}{suffix}"
            for stem in names
        )
        made[name] = Beam(name, target, wave, opd, axis, parameters)
        parts.append((at, own, suffix))
    return list(made.values()), parts


def _shared(reader: Tables, table: dict[str, Any], place: str, made: Mapping[str, Beam]) -> Beam:
    name = reader.text(table, place, "shares")
    if name not in made:
        known = f"one of {', '.join(made)}" if made else "none at the first beam"
        raise reader.error(f"{place}.shares", f"expected a beam that stands before it, {known}, found {literal(name)}")
    return made[name]


#: Largest tilt that a table may state, in deg.
_MOST_TILT = 80.0
_SIZES = ("least_gap_um", "fibre_radius_um", "mirror_radius_um", "max_tilt_deg", "max_fringe_rate_hz")
_KEYS = (*_SIZES, "together", "gap_um", "gap_sd_um")


def read_envelope(reader: Tables, cell: dict[str, Any], n_joints: int, beams: Sequence[Beam]) -> Envelope | None:
    """The envelope that a cell's table states, or None where it states none."""
    if "envelope" not in cell:
        return None
    if len(beams) > 1 or beams[0].target != "plane-mirror":
        what = "it keeps one plane mirror off one fibre; expected none in a cell with several beams or a corner cube"
        raise reader.error("envelope", f"{what}, whose clearances fpcal does not know")
    table = reader.table(cell, "", "envelope")
    reader.keys(table, "envelope", _KEYS)

    def number(key: str, low: float = 1e-6, high: float = 1e9, default: float | None = None) -> float:
        return reader.number(table, "envelope", key, low=low, high=high, default=default)

    if ("gap_um" in table) != ("gap_sd_um" in table):
        missing = "gap_sd_um" if "gap_um" in table else "gap_um"
        raise reader.error(f"envelope.{missing}", "expected gap_um and gap_sd_um together: the measured gap and its sd")
    least = number("least_gap_um")
    gap, gap_sd = (number(key) if key in table else None for key in ("gap_um", "gap_sd_um"))
    if gap is not None and gap <= least:
        text = f"the gap of {gap:g} um is below least_gap_um = {least:g}: no motion is left"
        raise reader.error("envelope.gap_um", text)
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
        what = f'expected groups of joints such as [["q1", "q2"]], from {", ".join(names)}; [] for none'
        raise reader.error("envelope.together", what)
    return tuple(tuple(sorted({names[name] for name in group})) for group in groups if group)


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


def read_tasks(reader: Tables, cell: dict[str, Any]) -> tuple[OwnTask, ...]:
    """The tasks that a cell's tables state."""
    found: list[OwnTask] = []
    for number, table in enumerate(reader.tables(cell, "task", "expected one [[task]] table for each task"), 1):
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
        low, high = (end * scale for end in reader.numbers(table, place, size, 2))
        if not low < high:
            raise reader.error(f"{place}.{size}", "expected low < high")
        if unit == "deg" and max(-low, high) > math.pi:
            raise reader.error(f"{place}.{size}", "expected angles from -180 to 180")
    x, y, z = reader.numbers(table, place, "centre_um", 3) if "centre_um" in table else (0.0, 0.0, 0.0)
    expected = "expected a table such as { beam_nm = 50 }"
    tolerance = reader.table(table, place, "tolerance", expected) if "tolerance" in table else {}
    reader.keys(tolerance, f"{place}.tolerance", set(_TOLERANCES))
    known = {
        freedom: per * reader.number(tolerance, f"{place}.tolerance", key, low=1e-9)
        for key, (freedom, per) in _TOLERANCES.items()
        if key in tolerance
    }
    return OwnTask(name, kind, radius, low, high, (x, y, z), known)


#: Keys that are meant for one kind of joint only, beside those in their own unit.
_LINEAR_ONLY = ("straightness_nm", "flatness_nm", "pitch_urad", "yaw_urad", "roll_urad", "crosstalk_nm")
_TURNING_ONLY = ("radial_runout_nm", "axial_runout_nm", "wobble_urad")
_IN_OWN_UNIT = {"linearity": "linearity", "reversal": "reversal", "return": "return_sd", "encoder": "encoder"}
#: Keys of the cell's own table, and the least that they may be.
_OF_CELL = {"drift_nm_per_min": 0.0, "minutes_per_sweep": 1e-6, "correlated_nm": 0.0}
#: No error motion of a positioner is as large as a millimetre or a milliradian times ten.
_LARGEST = 1e6


def read_mechanics(reader: Tables, table: dict[str, Any], joints: Sequence[Joint]) -> Mechanics | None:
    """Sizes of the error motions that a cell's tables state; None if not even a repeatability is stated."""
    parts, repeatable = table["joint"], any(joint.repeatability for joint in joints)
    if not any("mechanics" in part for part in (table, *parts)) and not repeatable:
        return None
    made = tuple(
        _of_joint(reader, part, f"joint {number}", joint)
        for number, (part, joint) in enumerate(zip(parts, joints, strict=True), 1)
    )
    whole = reader.optional(table, "", "mechanics")
    reader.keys(whole, "mechanics", _OF_CELL)
    sizes = {key: reader.number(whole, "mechanics", key, low=_OF_CELL[key], high=_LARGEST) for key in whole}
    found = Mechanics(made, **sizes)
    return found if found.any or repeatable else None


def _of_joint(reader: Tables, part: dict[str, Any], place: str, joint: Joint) -> JointMechanics:
    table = reader.optional(part, place, "mechanics")
    place, prismatic = f"{place}.mechanics", joint.kind == "prismatic"
    own, shown = ("nm", "um") if prismatic else ("urad", "deg")
    names = {key: key for key in (_LINEAR_ONLY if prismatic else _TURNING_ONLY)}
    names |= {f"{stem}_{own}": field for stem, field in _IN_OWN_UNIT.items()}
    names[f"encoder_period_{shown}"] = "encoder_period"
    reader.keys(table, place, (*names, "lever_mm", "source"))
    values: dict[str, Any] = {}
    for key in table:
        if key == "source":
            if not isinstance(table[key], str):
                raise reader.error(f"{place}.source", "expected a text")
            values[key] = table[key]
        elif key == "lever_mm":
            expected = "expected three numbers, from the sheet's point to the mirror"
            values[key] = tuple(reader.numbers(table, place, key, 3, expected, most=1e4))
        else:
            low = 1e-9 if key.startswith("encoder_period") else 0.0
            values[names[key]] = reader.number(table, place, key, low=low, high=_LARGEST)
    return JointMechanics(**values)
