"""What single tables of a cell's file state: drift sizes, [envelope], [optics], [[task]]."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class DriftSize:
    """Drift of one parameter: a sum of independent parts, each zero where it is absent; in um, rad and days."""

    name: str  # of the parameter
    walk: float = 0.0  # standard deviation of a random walk after one day; it grows with the square root of time
    rate_sd: float = 0.0  # standard deviation of a steady rate per day, unknown beforehand
    #: bounded_sd, bounded_hours: Standard deviation and time constant of a motion that returns (Ornstein-Uhlenbeck).
    bounded_sd: float = 0.0
    bounded_hours: float = 0.0
    #: temperature, temperature_sd: Change per kelvin of the logged temperature: expected value and its standard
    #: deviation.
    temperature: float = 0.0
    temperature_sd: float = 0.0

    def content(self) -> dict[str, Any]:
        """The sizes as a JSON-like value, for hashes."""
        return asdict(self)


#: Keys of a drift table that are sizes in the parameter's own unit, and the fewest they may be.
SIZES_IN_UNIT = dict.fromkeys(("walk", "rate_sd", "bounded_sd", "temperature_sd"), 0.0) | {"temperature": -math.inf}


@dataclass(frozen=True)
class Envelope:
    """Bounds of every motion of a cell, in um and rad; no part of its hash, for they change no cavity length."""

    least_gap: float  # between mirror and fibre, where the edges of both come nearest
    fibre_radius: float  # radius of the fibre's end, with its ferrule where that reaches as far
    mirror_radius: float  # radius of the mirror around the origin of its frame
    max_tilt: float  # largest angle between the mirror's normal and the light turned round
    max_fringe_rate: float  # half waves a second that the cavity length may change by
    together: tuple[tuple[int, ...], ...] = ()  # groups of joints, by position, that may move at the same time
    gap: float | None = None  # measured cavity length at joint zero, or None where nobody has measured it
    gap_sd: float | None = None  # its standard deviation


Beams = Literal["two-beam", "airy"]


@dataclass(frozen=True)
class Interferometer:
    """What stands between cavity length and voltage, by default common parts; no part of the cell's hash."""

    wavelength: float  # of the laser in vacuum, in um
    #: ``two-beam``: light reflected at the fibre end and once at the mirror; ``airy``: every further pass too.
    beams: Beams = "two-beam"
    #: Radius in um at which the field of the fibre mode falls to 1/e. Default 5.2: half the mode field diameter of
    #: standard single-mode fibre (ITU-T G.652) at 1550 nm.
    mode_field_radius: float = 5.2
    #: Of the fibre end. Default 0.033: Fresnel reflection of silica, index 1.444 (Malitson 1965), into air.
    fibre_reflectivity: float = 0.033
    mirror_reflectivity: float = 0.95  # of the mirror. Default 0.95: a metal film in the near infrared
    #: Volts of the photodiode per share of light that comes back. Default 50: fringes of 1 V at 0.92 mm.
    gain: float = 50.0
    dark: float = 0.05  # its voltage without light. Default 0.05 V
    noise: float = 0.01  # standard deviation of one sample's noise, in V. Default 0.01: a hundredth of such a fringe
    full_scale: float = 5.0  # the converter reads from 0 V to this; default 5 V
    bits: int = 16  # of the converter; default 16

    @property
    def step(self) -> float:
        """Volts between two readings of the converter."""
        steps: int = 2**self.bits - 1
        return self.full_scale / steps


#: What moves, by the kind of task: position of the offset (x y z rx ry rz of the fibre frame); a circle moves two.
OWN_KINDS: dict[str, int] = {"line-x": 0, "line-y": 1, "line-z": 2, "tilt-x": 3, "spin": 4, "tilt-z": 5, "circle": -1}


@dataclass(frozen=True)
class OwnTask:
    """One task; lengths in um, angles in rad, in the fibre frame and relative to the aligned pose."""

    name: str  # by which commands take it
    kind: str  # one of `OWN_KINDS`
    radius: float = 0.0  # radius of a circle; 0 for other kinds
    low: float = 0.0  # end of a line, a tilt or a spin; 0 for a circle
    high: float = 0.0  # likewise
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
