"""A cell: robot chain, mirror, fibre and optics, as described by a TOML file."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

JointKind = Literal["prismatic", "revolute"]

JOINT_UNITS: dict[JointKind, str] = {"prismatic": "um", "revolute": "deg"}


@dataclass(frozen=True)
class ControllerAxis:
    """How a motion controller names and counts one joint.

    The controller shows ``zero + sign * q`` in its own `unit`, q being the joint variable of the model.
    `per_unit` is the length of that unit in um or its angle in rad.
    """

    name: str
    channel: str
    sign: int
    zero: float
    unit: str
    per_unit: float

    def to_controller(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Controller readings of joint values `q` (um or rad), same shape."""
        return self.zero + self.sign * q / self.per_unit

    def to_model(self, reading: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint values (um or rad) of controller readings, same shape."""
        return self.sign * (reading - self.zero) * self.per_unit


@dataclass(frozen=True)
class Joint:
    """One joint: kind, limits (low, high; infinite where there is none), repeatability, controller, resolution, speed.

    Lengths in um, angles in rad. `repeatability` is the standard deviation of the reached position, `resolution` the
    smallest step (zero where it is not stated), `speed` what the joint travels or turns in a second at most, None where
    the cell does not say.
    """

    kind: JointKind
    low: float
    high: float
    repeatability: float
    controller: ControllerAxis | None
    resolution: float = 0.0
    speed: float | None = None

    @property
    def unit(self) -> str:
        """Unit in which a person reads the joint: um or deg."""
        return JOINT_UNITS[self.kind]
