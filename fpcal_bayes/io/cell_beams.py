"""The beams of a cell from the [[beam]] tables of its file."""

import re
from collections.abc import Mapping
from typing import Any, get_args

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.validate import Tables, literal
from fpcal_bayes.model.cell.beams import AT, PATHS, Beam, OpticalAxis, Target
from fpcal_bayes.model.cell.cell import extrinsics_of

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_KEYS = ("name", "shares", "target", "opd", "optical_axis", "wavelength_nm", "extrinsic")


def read_beams(
    reader: Tables, tables: object, first: Mapping[str, Any], extrinsic: dict[str, Any] | None
) -> tuple[list[Beam], list[tuple[str, dict[str, Any], str]]]:
    """The beams of a cell, and for each the place of its table of parameters, that table, and the names' suffix.

    first: what a beam has that states nothing else. extrinsic: the table [extrinsic] of the first beam, or None.
    """
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise reader.error("beam", f"expected one [[beam]] table for each beam, found {literal(tables)}")
    made: dict[str, Beam] = {}
    parts: list[tuple[str, dict[str, Any], str]] = []
    for number, table in enumerate(tables or [{}], 1):
        place = f"beam {number}" if tables else "extrinsic"
        reader.keys(table, place, _KEYS)
        name = reader.text(table, place, "name") if tables else ""
        if tables and (not _NAME.fullmatch(name) or name in made):
            what = f"expected another name for each beam, of letters, digits and -_., found {literal(name)}"
            raise reader.error(f"{place}.name", what)
        other = _shared(reader, table, place, made) if "shares" in table else None
        known = first if other is None else {key: getattr(other, key) for key in first}
        target = reader.choice(table, place, "target", get_args(Target), known["target"])
        stated = known["opd"] if known["opd"] in PATHS[target] else None
        opd = reader.choice(table, place, "opd", PATHS[target], stated)
        axis = reader.choice(table, place, "optical_axis", get_args(OpticalAxis), known["optical_axis"])
        shown = 1e3 * known["wavelength"]
        wave = reader.number(table, place, "wavelength_nm", low=1e-3, high=20_000.0, default=shown) * 1e-3
        wave = wave if "wavelength_nm" in table else known["wavelength"]

        own = reader.table(table, place, "extrinsic") if "extrinsic" in table else {}
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


def refuse_envelope(reader: Tables, beams: list[Beam]) -> None:
    """Raise `InputError` unless one plane mirror faces one fibre, which is what an envelope knows."""
    if len(beams) > 1 or beams[0].target != "plane-mirror":
        raise InputError(
            f"{reader.file}: key envelope: it keeps one plane mirror off one fibre; expected none in a cell with "
            "several beams or a corner cube, whose clearances fpcal does not know"
        )
