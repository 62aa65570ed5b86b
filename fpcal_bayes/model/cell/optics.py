"""The interferometer of a cell: fibre, surfaces and photodiode, as its TOML file states them."""

from dataclasses import dataclass
from typing import Literal

Beams = Literal["two-beam", "airy"]


@dataclass(frozen=True)
class Interferometer:
    """What stands between the cavity length and a voltage; no part of the cell's hash.

    The paper prints none of these numbers; the defaults are those of common parts.
    """

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
