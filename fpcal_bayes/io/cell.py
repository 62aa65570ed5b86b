"""A cell from its TOML description, with a message for everything that can be wrong in it."""

import math
import os
import re
import tomllib
from pathlib import Path
from typing import Any, Literal, get_args

from fpcal_bayes.core.errors import InputError, largest
from fpcal_bayes.core.files import read_text, write_text
from fpcal_bayes.core.resources import built_in_cells, data_file
from fpcal_bayes.io.cell_tables import read_beams, read_envelope, read_mechanics, read_tasks
from fpcal_bayes.io.validate import Tables, is_number, literal, read_toml
from fpcal_bayes.model.cell.beams import AT, Opd, OpticalAxis
from fpcal_bayes.model.cell.cell import Cell, ParameterEntry, make_parameters
from fpcal_bayes.model.cell.check import impossible
from fpcal_bayes.model.cell.joints import JOINT_UNITS, ControllerAxis, Joint
from fpcal_bayes.model.cell.tables import SIZES_IN_UNIT, Beams, DriftSize, Interferometer
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, SCALES, UNITS, ParameterSet
from fpcal_bayes.model.priors import LogNormal, Marginal, TruncatedNormal, Uniform

SCHEMA = "fpcal-cell/1"

#: A prior narrower than this, in um, deg or ppm, holds the parameter; zero says so.
_LEAST_SD = 1e-9

#: Units a motion controller may count in: um or rad per unit.
CONTROLLER_UNITS = {
    "prismatic": {"pm": 1e-6, "nm": 1e-3, "um": 1.0, "mm": 1e3, "m": 1e6},
    "revolute": {
        "udeg": math.radians(1e-6),
        "mdeg": math.radians(1e-3),
        "deg": math.radians(1.0),
        "urad": 1e-6,
        "mrad": 1e-3,
        "rad": 1.0,
    },
}

#: Keys of a parameter's table by its kind of prior, beside `prior`, `nominal` and `optional`.
_PRIOR_KEYS = {
    "normal": ("prior_sd_{unit}",),
    "truncated-normal": ("prior_sd_{unit}", "low_{unit}", "high_{unit}"),
    "half-normal": ("prior_sd_{unit}",),
    "uniform": ("low_{unit}", "high_{unit}"),
    "log-normal": ("prior_factor",),
}

#: Keys of [optics] that are numbers: field of `Interferometer`, lowest and highest value.
_OPTICS_KEYS = {
    "mode_field_radius_um": ("mode_field_radius", 0.1, 1e5),
    "fibre_reflectivity": ("fibre_reflectivity", 1e-6, 1.0),
    "mirror_reflectivity": ("mirror_reflectivity", 1e-6, 1.0),
    "gain_v": ("gain", 1e-9, 1e9),
    "dark_v": ("dark", -1e9, 1e9),
    "noise_v": ("noise", 0.0, 1e9),
    "full_scale_v": ("full_scale", 1e-9, 1e9),
}


def load_cell(
    source: str | Path = "femto-st",
    *,
    opd: Opd | None = None,
    mechanics: Literal["stated", "none"] = "stated",
    check: bool = True,
) -> Cell:
    """Read a cell by the name of a built-in one or from a TOML file.

    Parameters
    ----------
    opd
        Overrides the path model of the file.
    mechanics
        ``stated``: with the sizes of error motions that the file states; ``none``: the mechanism is taken as perfect.
    check
        Refuse geometry that cannot be right (see `fpcal_bayes.model.cell.check`).

    Raises
    ------
    InputError
        If the file is missing or holds an unknown key, a wrong type, an impossible unit or value.
    """
    path, reader = cell_path(source), _Reader(source)
    try:
        cell = read_toml(path, reader.cell)
    except InputError as error:
        known = "" if os.path.isfile(path) else f"; built-in cells: {', '.join(built_in_cells())}"
        raise InputError(f"{error}{known}") from error
    for key, what in impossible(cell) if check else ():
        raise reader.error(key, what)
    if mechanics == "none":
        cell = cell.ideal
    return cell if opd is None else cell.with_opd(opd)


def cell_path(source: str | Path) -> Path:
    """Where a cell's file stands."""
    return data_file(f"{source}.toml") if str(source) in built_in_cells() else Path(source)


#: A comment, a table's head with its first key, or a walk in a drift table.
_WALKS = re.compile(r"(#[^\n]*)|^[ \t]*\[+[ \t]*(\w+)|(\bwalk_\w+[ \t]*=[ \t]*)([-+.\w]+)", re.MULTILINE)


def write_resized_cell(source: str | Path, robot: float, mirror: float, output: Path) -> None:
    """Write a cell's file again, its walks `robot` and `mirror` times as large; all else stays as it stands."""
    path, table = cell_path(source), ""

    def resized(found: re.Match[str]) -> str:
        nonlocal table
        table = found[2] or table
        factor = mirror if table in ("extrinsic", "beam") else robot
        return f"{found[3]}{float(found[4]) * factor:.4g}" if found[3] else found[0]

    text = _WALKS.sub(resized, read_text(path))
    cell = load_cell(source)
    for now, before in zip(_Reader(source).cell(tomllib.loads(text)).drift, cell.drift, strict=True):
        wanted = before.walk * (mirror if cell.parameters[now.name].kind == "extrinsic" else robot)
        if not math.isclose(now.walk, wanted, rel_tol=1e-3):
            raise InputError(f"{source}: the drift of {now.name} stands in a way that is not understood")
    write_text(output, text)


#: Whether somebody has looked which way the axes go.
_CHECKED = "handedness_checked"


class _Reader(Tables):
    def cell(self, table: dict[str, Any]) -> Cell:
        self.keys(
            table,
            "",
            {"schema", "name", "optics", "joint", "beam", "extrinsic", "envelope", "mechanics", "task", _CHECKED},
        )
        if table.get("schema") != SCHEMA:
            raise self.error("schema", f"expected {SCHEMA!r}, found {literal(table.get('schema'))}")
        optics = self.table(table, "", "optics")
        self.keys(optics, "optics", {"wavelength_nm", "opd", "optical_axis", "beams", "bits", *_OPTICS_KEYS})
        wavelength = self.number(optics, "optics", "wavelength_nm", low=1e-3, high=20_000.0) * 1e-3
        opd = self.choice(optics, "optics", "opd", ("axis", "perpendicular"), "axis")
        optical_axis = self.choice(optics, "optics", "optical_axis", get_args(OpticalAxis), "minus-y")

        joints, entries = [], {}
        joint_tables = table.get("joint")
        if not isinstance(joint_tables, list) or not joint_tables:
            raise self.error("joint", "expected one [[joint]] table for each joint, from base to tool")
        for number, joint_table in enumerate(joint_tables, 1):
            place = f"joint {number}"
            if not isinstance(joint_table, dict):
                raise self.error(place, "expected a table")
            joints.append(self.joint(joint_table, place))
            for stem in LINK_SLOTS:
                if stem in joint_table:
                    entries[f"{stem}_{number}"] = self.parameter(joint_table, place, stem, stem in LINK_SLOTS[5:])
                    if stem.startswith("runout") and joints[-1].kind == "prismatic":
                        raise self.error(f"{place}.{stem}", "a prismatic joint has no runout")
        named = table.get("beam", [])
        stated = self.table(table, "", "extrinsic") if "extrinsic" in table or not named else None
        light = {"target": "plane-mirror", "opd": opd, "optical_axis": optical_axis, "wavelength": wavelength}
        beams, parts = read_beams(self, named, light, stated)
        for place, extrinsic, suffix in parts:
            for stem in extrinsic:
                if stem != "drift":
                    entries[f"{stem}{suffix}"] = self.parameter(extrinsic, place, stem, optional=False)
        own = [name for beam in beams[1:] for name in beam.parameters if name.endswith(f"{AT}{beam.name}")]
        parameters = make_parameters(entries, len(joints), beams[0].target, own)
        cell = Cell(
            name=self.text(table, "", "name"),
            joints=tuple(joints),
            parameters=parameters,
            wavelength=beams[0].wavelength,
            opd=beams[0].opd,
            optical_axis=beams[0].optical_axis,
            target=beams[0].target,
            beam=beams[0].name,
            further=tuple(beams[1:]),
            handedness_checked=self.flag(table, "", _CHECKED),
            drift=self.drifts(joint_tables, parts, parameters),
            optics=self.interferometer(optics, beams[0].wavelength),
            mechanics=read_mechanics(self, table, joints),
            envelope=read_envelope(self, table, len(joints), beams),
            tasks=read_tasks(self, table),
        )
        if not cell.free:
            raise self.error("joint", "no parameter has a prior_sd: there is nothing to identify")
        return cell

    def interferometer(self, optics: dict[str, Any], wavelength: float) -> Interferometer:
        bits = self.whole(optics, "optics", "bits", 1, 32, Interferometer.bits)
        numbers = {
            field: self.number(optics, "optics", key, low=low, high=high, default=getattr(Interferometer, field))
            for key, (field, low, high) in _OPTICS_KEYS.items()
        }
        beams = self.choice(optics, "optics", "beams", get_args(Beams), Interferometer.beams)
        return Interferometer(wavelength, beams, bits=bits, **numbers)

    def joint(self, table: dict[str, Any], place: str) -> Joint:
        kind = self.choice(table, place, "kind", tuple(JOINT_UNITS), None)
        unit = JOINT_UNITS[kind]
        speed_key = f"speed_{unit}_per_s"
        own = {speed_key, *(f"{key}_{unit}" for key in ("limits", "repeatability", "resolution"))}
        self.keys(table, place, {"kind", "controller", "drift", "mechanics", *own, *LINK_SLOTS})
        low, high = -math.inf, math.inf
        if f"limits_{unit}" in table:
            limits = table[f"limits_{unit}"]
            if not (isinstance(limits, list) and len(limits) == 2 and all(map(is_number, limits))):
                raise self.error(f"{place}.limits_{unit}", f"expected two numbers [low, high], found {literal(limits)}")
            far, (low, high) = max(map(abs, limits)) > largest(unit), (float(x) * SCALES[unit] for x in limits)
            if far or not low < high:
                expected = f"at most {largest(unit):g}" if far else "low < high"
                raise self.error(f"{place}.limits_{unit}", f"expected {expected}, found {literal(limits)}")
        repeatability, resolution = (
            self.number(table, place, f"{key}_{unit}", low=0.0, default=0.0) * SCALES[unit]
            for key in ("repeatability", "resolution")
        )
        controller = self.controller(table, place, kind) if "controller" in table else None
        speed = self.number(table, place, speed_key, low=1e-9) * SCALES[unit] if speed_key in table else None
        return Joint(kind, low, high, repeatability, controller, resolution, speed)

    def controller(self, table: dict[str, Any], place: str, kind: str) -> ControllerAxis:
        axis = self.table(table, place, "controller")
        place = f"{place}.controller"
        self.keys(axis, place, {"name", "channel", "sign", "zero", "unit"})
        units = CONTROLLER_UNITS[kind]
        unit = self.choice(axis, place, "unit", tuple(units), JOINT_UNITS[kind])  # type: ignore[index]
        sign = axis.get("sign", 1)
        if sign not in (1, -1) or isinstance(sign, bool):
            raise self.error(f"{place}.sign", f"expected 1 or -1, found {literal(sign)}")
        return ControllerAxis(
            name=self.text(axis, place, "name"),
            channel=self.text(axis, place, "channel"),
            sign=int(sign),
            zero=self.number(axis, place, "zero", default=0.0),
            unit=unit,
            per_unit=units[unit],
        )

    def parameter(self, parent: dict[str, Any], place: str, stem: str, optional: bool) -> ParameterEntry:
        table = self.table(parent, place, stem)
        place, unit = f"{place}.{stem}", UNITS[stem]
        kind = self.choice(table, place, "prior", tuple(_PRIOR_KEYS), "normal")
        allowed = {key.format(unit=unit) for key in _PRIOR_KEYS[kind]}
        self.keys(table, place, {"prior", f"nominal_{unit}", "optional", *allowed})

        def length(stem: str, *, low: float = -math.inf, default: float | None = None) -> float:
            value = self.number(table, place, f"{stem}_{unit}", low=low, default=default)
            if stem == "prior_sd" and 0.0 < value < _LEAST_SD:
                raise self.error(f"{place}.{stem}_{unit}", f"expected 0 (held) or at least {_LEAST_SD:g}")
            return value * SCALES[unit]

        flag = self.flag(table, place, "optional", optional)
        if kind == "normal":
            return ParameterEntry(length("nominal", default=0.0), length("prior_sd", low=0.0, default=0.0), flag)
        ends = [length(end) if f"{end}_{unit}" in table else None for end in ("low", "high")]
        prior: Marginal
        try:
            if kind == "uniform":
                low, high = length("low"), length("high")
                nominal = length("nominal", default=(low + high) / 2 / SCALES[unit])
                prior = Uniform(low, high)
                if not low < nominal < high:
                    raise InputError("a uniform prior: expected low < nominal < high")
            elif kind == "log-normal":
                nominal = length("nominal")
                prior = LogNormal(nominal, self.number(table, place, "prior_factor", high=1e3))
            else:
                nominal = length("nominal", default=0.0)
                low = nominal if kind == "half-normal" else -math.inf if ends[0] is None else ends[0]
                prior = TruncatedNormal(nominal, length("prior_sd"), low, math.inf if ends[1] is None else ends[1])
        except InputError as error:
            raise error if place in str(error) else self.error(place, str(error)) from error
        return ParameterEntry(nominal, prior.sd, flag, prior)

    def drifts(
        self, joints: list[dict[str, Any]], beams: list[tuple[str, dict[str, Any], str]], parameters: ParameterSet
    ) -> tuple[DriftSize, ...]:
        """Drift of the parameters that name one, in the cell's order."""
        found: dict[str, DriftSize] = {}
        known = [p.name for p in parameters if p.prior_sd > 0]
        links = [(f"joint {number}", table, f"_{number}") for number, table in enumerate(joints, 1)]
        for place, table, suffix in [*links, *beams]:
            if "drift" not in table:
                continue
            drift = self.table(table, place, "drift")
            stems = {stem: f"{stem}{suffix}" for stem in (*LINK_SLOTS, *EXTRINSICS, "x_et", "y_et")}
            free = {stem: name for stem, name in stems.items() if name in known}
            self.keys(drift, f"{place}.drift", set(free))
            for stem, name in free.items():
                if stem in drift:
                    found[name] = self.drift_size(drift, f"{place}.drift", stem, name)
        return tuple(found[name] for name in parameters.names if name in found)

    def drift_size(self, parent: dict[str, Any], place: str, stem: str, name: str) -> DriftSize:
        table, unit = self.table(parent, place, stem), UNITS[stem]
        place = f"{place}.{stem}"
        self.keys(table, place, {"bounded_hours", *(f"{size}_{unit}" for size in SIZES_IN_UNIT)})
        sizes = {
            size: self.number(table, place, f"{size}_{unit}", low=low, default=0.0) * SCALES[unit]
            for size, low in SIZES_IN_UNIT.items()
        }
        hours = self.number(table, place, "bounded_hours", low=0.0, default=0.0)
        if (sizes["bounded_sd"] > 0) != (hours > 0):
            raise self.error(f"{place}.bounded_hours", f"expected bounded_hours and bounded_sd_{unit} together")
        return DriftSize(name, bounded_hours=hours, **sizes)
