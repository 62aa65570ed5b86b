"""A cell: robot chain, mirror, fibre and optics, as described by a TOML file."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpcal_bayes.core.errors import InputError

JointKind = Literal["prismatic", "revolute"]

JOINT_UNITS: dict[JointKind, str] = {"prismatic": "um", "revolute": "deg"}


@dataclass(frozen=True)
class ControllerAxis:
    """How a motion controller names and counts one joint: it shows ``zero + sign * q`` in its own `unit`."""

    name: str
    channel: str
    sign: int
    zero: float
    unit: str
    per_unit: float  # um or rad

    def reading_of(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Controller readings of joint values `q` (um or rad), same shape."""
        return self.zero + self.sign * q / self.per_unit

    def joint_value(self, reading: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint values (um or rad) of controller readings, same shape."""
        return self.sign * (reading - self.zero) * self.per_unit


@dataclass(frozen=True)
class Joint:
    """One joint; lengths in um, angles in rad."""

    kind: JointKind
    low: float  # limit, infinite where there is none
    high: float  # likewise
    repeatability: float  # standard deviation of the reached position
    controller: ControllerAxis | None
    resolution: float = 0.0  # smallest step; zero where it is not stated
    speed: float | None = None  # what it travels or turns in a second at most, where the cell says so

    @property
    def unit(self) -> str:
        """Unit in which a person reads the joint: um or deg."""
        return JOINT_UNITS[self.kind]

    def to_controller(self, shown: ArrayLike) -> NDArray[np.float64]:
        """What the controller shows at joint values as files hold them (um or deg); `InputError` if there is none."""
        values = np.asarray(shown, dtype=float)
        return self._axis().reading_of(values if self.kind == "prismatic" else np.radians(values))

    def from_controller(self, reading: ArrayLike) -> NDArray[np.float64]:
        """Joint values as files hold them (um or deg) of what the controller shows; as `to_controller`."""
        values = self._axis().joint_value(np.asarray(reading, dtype=float))
        return values if self.kind == "prismatic" else np.degrees(values)

    def _axis(self) -> ControllerAxis:
        if self.controller is None:
            raise InputError("the cell names no controller for this joint: expected a key controller in its table")
        return self.controller
