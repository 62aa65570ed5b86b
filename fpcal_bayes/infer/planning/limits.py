"""What the joints can do and the interferometer can follow, and how long a sweep takes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.model.cell import Cell

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SweepLimits:
    """Bounds of candidate sweeps; lengths in um, angles in rad.

    Attributes
    ----------
    tilt
        Largest angle between mirror normal and optical axis at which fringes are visible. The paper's sweeps reach
        4.24 deg, with both goniometers at 3 deg.
    fringe_rate
        Fringes (changes of lambda/2) a second that can be counted.
    travel_speed, turn_speed
        Of the joints, a second.
    settling
        Seconds to wait before a reading.
    free_travel, free_turn
        How far a joint without limit is moved, to either side of zero.
    reversal_variance
        Factor on a sweep's variance, when sweeps are chosen, where the cavity length turns round on the way by more
        than half a fringe: counting fringes takes the wrong sign there.
    """

    tilt: float = float(np.radians(4.3))
    fringe_rate: float = 1000.0
    travel_speed: float = 100.0
    turn_speed: float = float(np.radians(2.0))
    settling: float = 1.0
    free_travel: float = 150.0
    free_turn: float = float(np.radians(90.0))
    reversal_variance: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and (value >= 0 if name == "settling" else value > 0)):
                raise InputError(f"limit {name} of a sweep: expected a number above zero, found {value:g}")
        if self.tilt >= np.pi / 2:
            raise InputError(f"limit tilt of a sweep: expected less than 90 deg, found {np.degrees(self.tilt):g}")

    def ranges(self, cell: Cell) -> tuple[Floats, Floats]:
        """Lowest and highest value of each joint, shape (n_joints,) each."""
        free = np.where(cell.revolute, self.free_turn, self.free_travel)
        low = np.where(np.isfinite(cell.low), cell.low, -free)
        high = np.where(np.isfinite(cell.high), cell.high, free)
        return low, high

    def seconds(self, cell: Cell, moves: Floats) -> Floats:
        """Time that moves (..., n_joints) take, all joints at once; shape (...)."""
        speeds = np.where(cell.revolute, self.turn_speed, self.travel_speed)
        longest: Floats = (np.abs(moves) / speeds).max(axis=-1)
        return longest


def controllers(cell: Cell) -> list[NDArray[np.int64]]:
    """Positions of the joints that each motion controller moves; a joint without controller stands alone.

    Only joints of one controller move in step.
    """
    by_name: dict[str, list[int]] = {}
    for position, joint in enumerate(cell.joints):
        name = f"joint {position}" if joint.controller is None else f"controller {joint.controller.name}"
        by_name.setdefault(name, []).append(position)
    return [np.array(positions) for positions in by_name.values()]
