"""A cell: robot chain, mirror, fibre and optics, as described by a TOML file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import content_sha256
from fpcal_bayes.core.linalg import finite
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.cell.beams import AT, PATHS, Beam, Opd, OpticalAxis, Target
from fpcal_bayes.model.cell.error_motions import Mechanics
from fpcal_bayes.model.cell.joints import Joint
from fpcal_bayes.model.cell.tables import DriftSize, Envelope, Interferometer, OwnTask
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, POINT_EXTRINSICS, UNITS, Parameter, ParameterSet
from fpcal_bayes.model.priors import Marginal


class View(NamedTuple):
    """A cell of one of its beams alone, and where its model vector stands in that of the whole cell."""

    cell: "Cell"
    slots: Ints  # shape (view's model size,)


def _of_joints(name: str) -> "cached_property[Floats]":
    """A property of a cell: what its joints state under a name, shape (n_joints,)."""
    return cached_property(lambda cell: np.array([getattr(joint, name) for joint in cell.joints]))


@dataclass(frozen=True)
class Cell:
    """A robot, its mirror, the fibre that faces it, and the optics."""

    name: str
    joints: tuple[Joint, ...]  # from base to tool
    parameters: ParameterSet  # every parameter of the model vector, in its order, freed or not
    wavelength: float  # in um
    opd: Opd  # length that the interferometer sees: along the optical axis, or perpendicular to the mirror
    optical_axis: OpticalAxis  # axis of the fibre frame along which light leaves
    drift: tuple[DriftSize, ...] = ()  # parameters that are not named stay
    optics: Interferometer | None = None  # fibre, surfaces and photodiode; see `interferometer`
    envelope: Envelope | None = None  # what keeps the mirror off the fibre, where the cell says so
    tasks: tuple[OwnTask, ...] = ()  # beside those that every cell has
    mechanics: Mechanics | None = None  # sizes of the error motions, outside `sha256`; None: a perfect mechanism
    handedness_checked: bool = False  # whether somebody looked which way axes go: lengths do not tell mirror images
    target: Target = "plane-mirror"
    beam: str = ""  # name of the first beam, whose path model, wavelength and target stand above; empty if unnamed
    further: tuple[Beam, ...] = ()  # the other beams

    @property
    def beams(self) -> tuple[str, ...]:
        """Names of the beams, the first one's empty in a cell that names none."""
        return (self.beam, *(beam.name for beam in self.further))

    def require_one_beam(self, what: str) -> None:
        """Raise `InputError` in a cell with several beams, since `what` knows one only."""
        if self.further:
            raise InputError(f"cell {self.name!r} has {len(self.beams)} beams: {what} knows one only; expected sweeps")

    def beam_numbers(self, names: NDArray[np.str_]) -> Ints:
        """Number of the beam of each name, shape (n,); an empty name is the first beam's."""
        if not self.further:
            return np.zeros(len(names), dtype=np.int64)
        number = {"": 0} | {name: i for i, name in enumerate(self.beams)}
        return np.array([number[name] for name in names.tolist()], dtype=np.int64)

    @cached_property
    def views(self) -> tuple[View, ...]:
        """The cell as each of its beams sees it, in their order."""
        links = np.arange(len(LINK_SLOTS) * len(self.joints))
        own = np.arange(len(self.parameters) - len(EXTRINSICS), len(self.parameters))
        if not self.further:
            return (View(self, np.concatenate([links, own])),)
        made = []
        for beam in [Beam(self.beam, self.target, self.wavelength, self.opd, self.optical_axis, ()), *self.further]:
            index = np.concatenate([links, self.parameters.positions(beam.parameters) if beam.parameters else own])
            parameters = ParameterSet(
                replace(self.parameters[int(i)], name=self.parameters[int(i)].name.partition(AT)[0], slot=slot)
                for slot, i in enumerate(index)
            )
            own_light = {name: getattr(beam, name) for name in ("wavelength", "opd", "optical_axis", "target")}
            cell = replace(self, parameters=parameters, beam=beam.name, further=(), drift=(), **own_light)
            made.append(View(cell, index))
        return tuple(made)

    @cached_property
    def interferometer(self) -> Interferometer:
        """The interferometer; its defaults where the cell does not state one."""
        known = Interferometer(self.wavelength) if self.optics is None else self.optics
        return replace(known, wavelength=self.wavelength)

    @cached_property
    def revolute(self) -> NDArray[np.bool_]:
        """Whether each joint turns, shape (n_joints,)."""
        return np.array([j.kind == "revolute" for j in self.joints])

    @cached_property
    def joint_scales(self) -> NDArray[np.float64]:
        """Internal units per shown unit of each joint, shape (n_joints,)."""
        return np.where(self.revolute, np.pi / 180.0, 1.0)

    @cached_property
    def joint_columns(self) -> tuple[str, ...]:
        """Name and unit of each joint as in file headers: ``q1_um``, ``q4_deg``."""
        return tuple(f"q{i}_{j.unit}" for i, j in enumerate(self.joints, 1))

    # low, high: limits; repeatability: sd of the reached position; resolution: smallest step, which `sha256` leaves out
    low = _of_joints("low")
    high = _of_joints("high")
    repeatability = _of_joints("repeatability")
    resolution = _of_joints("resolution")

    @cached_property
    def free(self) -> ParameterSet:
        """The parameters identified by default: those with a prior that are not optional."""
        return ParameterSet(p for p in self.parameters if p.prior_sd > 0 and not p.optional)

    @cached_property
    def sha256(self) -> str:
        """Hash of everything that the cell's numbers depend on; layout and comments of the file do not."""
        rest = [[b.name, b.target, b.wavelength, b.opd, b.optical_axis, *b.parameters] for b in self.further]
        beams = [[self.beam, self.target], *rest]
        return content_sha256(
            {
                "name": self.name,
                "wavelength": self.wavelength,
                "opd": self.opd,
                "optical_axis": self.optical_axis,
                "joints": [[j.kind, finite(j.low), finite(j.high), j.repeatability] for j in self.joints],
                "parameters": [
                    [p.name, p.nominal, p.prior_sd, p.optional, *_settings(p.prior)] for p in self.parameters
                ],
                # A cell with one nameless beam on a plane mirror has no beams in its hash.
                **({"beams": beams} if self.beam or self.further or self.target != "plane-mirror" else {}),
            }
        )

    @property
    def ideal(self) -> "Cell":
        """The same cell with a mechanism that is taken as perfect."""
        return self if self.mechanics is None else replace(self, mechanics=None)

    def with_opd(self, opd: Opd) -> "Cell":
        """The same cell with the other path model, on each beam whose target has it; `InputError` if none has."""
        if not any(opd in PATHS[target] for target in (self.target, *(beam.target for beam in self.further))):
            raise InputError(f"path model {opd!r}: the targets of cell {self.name!r} have no such path")
        further = tuple(replace(beam, opd=opd) if opd in PATHS[beam.target] else beam for beam in self.further)
        return replace(self, opd=opd if opd in PATHS[self.target] else self.opd, further=further)

    def select(self, names: str | Sequence[str]) -> ParameterSet:
        """Parameters by name, ``all``, ``intrinsic`` or ``extrinsic``, with commas or listed, in the cell's order."""
        wanted: set[str] = set()
        for name in names.split(",") if isinstance(names, str) else names:
            if name in ("all", "intrinsic", "extrinsic"):
                wanted |= {p.name for p in self.free if name in ("all", p.kind)}
            elif name not in self.parameters:
                known = ", ".join(p.name for p in self.parameters if p.prior_sd > 0)
                raise InputError(f"unknown parameter {name!r}: expected all, intrinsic, extrinsic, or some of {known}")
            elif self.parameters[name].prior_sd == 0:
                raise InputError(f"parameter {name!r} has no prior_sd in cell {self.name!r}: it cannot be freed")
            else:
                wanted.add(name)
        return ParameterSet(p for p in self.parameters if p.name in wanted)

    def __repr__(self) -> str:
        chain = "".join("P" if j.kind == "prismatic" else "R" for j in self.joints)
        return f"Cell({self.name!r}, chain {chain}, {len(self.free)} free parameters, opd {self.opd!r})"


class ParameterEntry(NamedTuple):
    """What a cell says of a parameter, in internal units; `prior` where it is not normal."""

    nominal: float
    prior_sd: float
    optional: bool
    prior: Marginal | None = None


def make_parameters(
    entries: Mapping[str, ParameterEntry | tuple[float, float, bool]],
    n_joints: int,
    target: Target = "plane-mirror",
    further: Sequence[str] = (),
) -> ParameterSet:
    """Every parameter of the model vector of a chain, zero where no entry is; `further` are those of further beams."""
    names = [(f"{stem}_{i}", UNITS[stem], "intrinsic") for i in range(1, n_joints + 1) for stem in LINK_SLOTS]
    names += [(name, UNITS[name.partition(AT)[0]], "extrinsic") for name in (*further, *extrinsics_of(target))]
    unknown = set(entries) - {name for name, _, _ in names}
    if unknown:
        raise InputError(f"unknown parameter {sorted(unknown)[0]!r} for a chain of {n_joints} joints")
    made = []
    for slot, (name, unit, kind) in enumerate(names):
        nominal, prior_sd, optional, prior = ParameterEntry(*entries.get(name, (0.0, 0.0, False)))
        made.append(Parameter(name, unit, nominal, prior_sd, kind, slot, optional, prior))  # type: ignore[arg-type]
    return ParameterSet(made)


def extrinsics_of(target: Target) -> tuple[str, ...]:
    """Names of the extrinsic parameters of a beam with this target, in the order of the model vector."""
    return EXTRINSICS if target == "plane-mirror" else POINT_EXTRINSICS


#: Turns from zero within which a joint without limits stands.
_MOST_TURNS = 2


def check_joints(
    cell: Cell, q: NDArray[np.float64], file: object, rows: Sequence[int] | None, columns: Sequence[str]
) -> None:
    """Raise `InputError` at the first of joint vectors (n, n_joints), in um and rad, outside the cell's limits."""
    # The tolerance lets a limit written in degrees survive its conversion to radians.
    slack = 1e-9 * (1.0 + np.abs(q))
    # An endless joint that stands many turns away is a value in another unit.
    endless = cell.revolute & np.isinf(cell.low) & np.isinf(cell.high)
    far = endless & (np.abs(q) > _MOST_TURNS * 2.0 * np.pi + slack)
    for bad in (far, (q < cell.low - slack) | (q > cell.high + slack)):
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            joint, scale = cell.joints[column], cell.joint_scales[column]
            value, low, high = (x / scale for x in (q[row, column], joint.low, joint.high))
            if bad is far:
                what = f"{value:.6g} deg is more than two turns from zero, expected a value in deg within them, or "
                what += "limits_deg in the cell"
            else:
                what = f"{value:g} {joint.unit} is outside the limits of cell {cell.name!r}, expected "
                what += f"{low:g} to {high:g} {joint.unit}"
            raise located(file, what, row=rows[row] if rows is not None else row + 1, column=columns[column])


def _settings(prior: Marginal | None) -> list[str | float | None]:
    return [] if prior is None else [prior.kind, *map(finite, prior.settings())]


def describe(cell: Cell) -> dict[str, Any]:
    """Name and hash of a cell, as written into estimates and campaigns."""
    return {"name": cell.name, "sha256": cell.sha256, "opd": cell.opd}
