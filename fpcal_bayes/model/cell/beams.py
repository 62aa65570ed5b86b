"""The beams of a cell that has several, or one that ends on a point: what each looks at, and along which path.

A beam is told by eight extrinsic parameters: where its target sits in the tool frame, where its light starts and which
way it points. A further beam has parameters of its own, `x_wf@NAME`, and shares the others with the beam it names.
"""

from dataclasses import dataclass
from typing import Literal

Opd = Literal["axis", "perpendicular", "distance"]
OpticalAxis = Literal["minus-y", "z"]
#: ``plane-mirror``: the plane through the target's origin; ``corner-cube``: a point, the cube's centre or a ball's.
Target = Literal["plane-mirror", "corner-cube"]

#: Paths along which a target's length is counted.
PATHS: dict[Target, tuple[Opd, ...]] = {"plane-mirror": ("axis", "perpendicular"), "corner-cube": ("axis", "distance")}
#: Between a parameter's name and that of the further beam which it belongs to.
AT = "@"


@dataclass(frozen=True)
class Beam:
    """One further beam of a cell."""

    name: str
    target: Target
    wavelength: float  # in um
    opd: Opd  # path model
    optical_axis: OpticalAxis
    #: Names of its extrinsic parameters, in the order of `extrinsics_of`: its own, ``x_wf@NAME``, or those it shares.
    parameters: tuple[str, ...]
