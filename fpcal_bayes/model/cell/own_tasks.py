"""Tasks of one's own, as a cell's [[task]] tables state them."""

import math
from dataclasses import dataclass, field

#: What moves, by the kind of task: position of the offset (x y z rx ry rz of the fibre frame); a circle moves two.
OWN_KINDS: dict[str, int] = {"line-x": 0, "line-y": 1, "line-z": 2, "tilt-x": 3, "spin": 4, "tilt-z": 5, "circle": -1}


@dataclass(frozen=True)
class OwnTask:
    """One task; lengths in um, angles in rad, in the fibre frame and relative to the aligned pose."""

    name: str  # by which commands take it
    kind: str  # one of `OWN_KINDS`
    radius: float = 0.0  # radius of a circle; 0 for other kinds
    # low, high: ends of a line, a tilt or a spin; 0 for a circle
    low: float = 0.0
    high: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # offset of the middle: x, y, z in um
    # largest peak to peak by degree of freedom: ``beam``, ``x``, ``z`` in um, ``rx``, ``ry``, ``rz`` in rad
    tolerances: dict[str, float] = field(default_factory=dict)

    @property
    def stated(self) -> dict[str, float]:
        """The tolerances under their keys in the cell's file: ``beam_nm``, ``rx_deg``, ..."""
        return {
            f"{name}_deg" if name.startswith("r") else f"{name}_nm": math.degrees(limit)
            if name.startswith("r")
            else 1e3 * limit
            for name, limit in self.tolerances.items()
        }

    @property
    def turns(self) -> bool:
        """Whether the mirror turns on the way."""
        return OWN_KINDS[self.kind] >= 3
