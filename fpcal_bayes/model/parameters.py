"""The parameters of a cell: their names, units, nominal values and priors."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model.priors import Marginal

Kind = Literal["intrinsic", "extrinsic"]

#: Internal units (um, rad, 1) per unit shown to a person.
SCALES = {"um": 1.0, "deg": float(np.pi / 180.0), "ppm": 1e-6}

LINK_SLOTS = ("beta", "alpha", "d", "theta", "r", "gain", "runout_cos", "runout_sin")
EXTRINSICS = ("beta_et", "theta_et", "beta_wf", "theta_wf", "z_et", "x_wf", "y_wf", "z_wf")
#: Those of a target that is a point, in the same places: where it is in the tool frame in place of how a mirror stands.
POINT_EXTRINSICS = ("x_et", "y_et", *EXTRINSICS[2:])
UNITS = {
    **dict.fromkeys(("beta", "alpha", "theta", "beta_et", "theta_et", "beta_wf", "theta_wf"), "deg"),
    **dict.fromkeys(("d", "r", "runout_cos", "runout_sin", "x_et", "y_et", "z_et", "x_wf", "y_wf", "z_wf"), "um"),
    "gain": "ppm",
}
_LATEX = {"beta": r"\beta", "alpha": r"\alpha", "theta": r"\theta", "gain": "g", "runout_cos": "c", "runout_sin": "s"}


@dataclass(frozen=True)
class Parameter:
    """One geometric parameter of a cell."""

    name: str  # as in every file, table and plot: ``alpha_2``, ``beta_wf``
    unit: str  # ``deg``, ``um`` or ``ppm``: the unit in which a person reads and writes it
    nominal: float  # in internal units (rad, um, 1)
    prior_sd: float  # likewise; zero where the parameter cannot be freed
    kind: Kind  # ``intrinsic`` (of the robot) or ``extrinsic`` (where mirror and fibre sit)
    #: Position in the model vector: `LINK_SLOTS` of each link, what further beams have of their own, then the
    #: `EXTRINSICS` of the first beam.
    slot: int
    optional: bool = False  # freed only when it is asked for by name
    prior: Marginal | None = None  # the prior where it is not normal; `prior_sd` is its standard deviation

    @property
    def scale(self) -> float:
        """Internal units per shown unit."""
        return SCALES[self.unit]

    @property
    def latex(self) -> str:
        """Label for plots, in LaTeX mathematics with the unit."""
        stem, _, index = self.name.rpartition("_")
        unit = {"deg": r"^\circ", "um": r"\mu m", "ppm": r"\mathrm{ppm}"}[self.unit]
        return rf"${_LATEX.get(stem, stem)}_{{{index}}}\ [{unit}]$"

    def shown(self, internal: float) -> float:
        """Convert a value from internal units to the shown unit."""
        return internal / self.scale


def _of_each(name: str) -> "cached_property[NDArray[np.float64]]":
    """A property of a set: what each of its parameters has under a name, shape (n,)."""
    return cached_property(lambda own: np.array([getattr(p, name) for p in own], dtype=float))


class ParameterSet:
    """An ordered set of parameters with distinct names, found by position or by name."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._parameters = tuple(parameters)
        self._positions = {p.name: i for i, p in enumerate(self._parameters)}
        if len(self._positions) != len(self._parameters):
            raise ValueError("parameter names repeat")

    def __len__(self) -> int:
        return len(self._parameters)

    @overload
    def __getitem__(self, key: int | str) -> Parameter: ...

    @overload
    def __getitem__(self, key: slice) -> "ParameterSet": ...

    def __getitem__(self, key: int | str | slice) -> "Parameter | ParameterSet":
        if isinstance(key, str):
            return self._parameters[self.position(key)]
        return ParameterSet(self._parameters[key]) if isinstance(key, slice) else self._parameters[key]

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self._parameters)

    def __contains__(self, item: object) -> bool:
        return item in self._positions if isinstance(item, str) else item in self._parameters

    def __repr__(self) -> str:
        return f"ParameterSet({', '.join(self.names)})"

    def position(self, name: str) -> int:
        """Position of the parameter called `name`; `InputError` if there is none."""
        if name not in self._positions:
            raise InputError(f"unknown parameter {name!r}: expected one of {', '.join(self._positions)}")
        return self._positions[name]

    def positions(self, names: Iterable[str]) -> NDArray[np.int64]:
        """Positions of the parameters called `names`, in their order."""
        return np.array([self.position(name) for name in names], dtype=np.int64)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(p.name for p in self._parameters)

    @cached_property
    def slots(self) -> NDArray[np.int64]:
        """Positions in the model vector, shape (n,)."""
        return np.array([p.slot for p in self._parameters], dtype=np.int64)

    # nominal values and prior standard deviations in internal units, and internal units per shown one, shape (n,) each
    nominal = _of_each("nominal")
    prior_sd = _of_each("prior_sd")
    scales = _of_each("scale")

    def to_shown(self, internal: ArrayLike) -> NDArray[np.float64]:
        """Convert values (..., n) from internal units to those a person reads."""
        return np.asarray(internal, dtype=float) / self.scales

    def to_internal(self, shown: ArrayLike) -> NDArray[np.float64]:
        """Convert values (..., n) from the units a person reads to internal ones."""
        return np.asarray(shown, dtype=float) * self.scales

    def from_mapping(self, shown: dict[str, float]) -> NDArray[np.float64]:
        """Internal values (n,) from shown values by name; the rest is nominal."""
        values = self.nominal.copy()
        for name, value in shown.items():
            position = self.position(name)
            values[position] = value * self._parameters[position].scale
        return values
