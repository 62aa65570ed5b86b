"""How much of a Gaussian beam a single-mode fibre takes back, in closed form.

The mode is Gaussian (D. Marcuse, Bell System Technical Journal 56, 703 (1977)); a beam whose waist equals the mode
leaves the fibre, and the mirror returns it as if it came from the fibre's mirror image. Its field in the plane of the
fibre end is expanded to second order around the fibre's centre, so that the overlap integral with the mode is Gaussian
too (as W. B. Joyce and B. C. DeLoach, Applied Optics 23, 4187 (1984), for tilt and offset of two such beams). The
expansion is exact for the Gaussian beam of the paraxial wave equation but for the change of its radius of curvature
across the mode, parts in a thousand here.

A wave is exp(-i k z) for light that travels along z; the phase of a coupling thus is minus k times a path.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


def coupling(
    distance: ArrayLike, tilt: ArrayLike, offset: ArrayLike, *, mode_field_radius: float, wavelength: ArrayLike
) -> Complexes:
    """Amplitude of the fibre mode that a beam excites.

    Parameters
    ----------
    distance
        From the beam's waist to the fibre end, along the beam, in um.
    tilt
        Angle between the beam and the fibre's axis, in rad, in the plane of the offset.
    offset
        Of the fibre's centre from the beam's axis, across the beam, in um; positive to the side to which the fibre
        plane's X axis points, along which a positive tilt makes the light arrive later.
    mode_field_radius
        Of fibre mode and beam waist, in um.
    wavelength
        In the medium, in um. All array arguments broadcast.

    Returns
    -------
    ndarray
        Complex; its size is at most one (for small tilts), its square the share of power.
    """
    wave_number = 2.0 * np.pi / np.asarray(wavelength, dtype=float)
    angle, aside = np.asarray(tilt, dtype=float), np.asarray(offset, dtype=float)
    rayleigh = wave_number * mode_field_radius**2 / 2.0
    curve = np.asarray(distance, dtype=float) + 1j * rayleigh
    # Exponent of the integrand: -along x^2 - slope x - start, and -across y^2.
    across = mode_field_radius**-2.0 + 1j * wave_number / (2.0 * curve)
    along = mode_field_radius**-2.0 + 1j * wave_number * np.cos(angle) ** 2 / (2.0 * curve)
    slope = 1j * wave_number * (np.sin(angle) + aside * np.cos(angle) / curve)
    start = 1j * wave_number * (np.asarray(distance, dtype=float) + aside**2 / (2.0 * curve))
    size = 2.0 / mode_field_radius**2 * 1j * rayleigh / (curve * np.sqrt(across * along))
    result: Complexes = size * np.exp(slope**2 / (4.0 * along) - start)
    return result


def mirror_coupling(
    distance: ArrayLike, tilt: ArrayLike, *, mode_field_radius: float, wavelength: ArrayLike
) -> Complexes:
    """Amplitude of the fibre mode after one reflection at a plane mirror.

    Parameters
    ----------
    distance
        From the fibre end to the mirror plane, perpendicular to it, in um.
    tilt
        Angle between the mirror's normal and the fibre's axis, in rad.
    mode_field_radius, wavelength
        As in `coupling`.

    Returns
    -------
    ndarray
        Complex, without the mirror's own reflectivity and phase. Minus its phase over twice the wave number is the
        length that an interferometer sees. As the mirror tilts it follows `distance`, whatever the mode's radius: the
        field that comes back and the one that the fibre takes overlap around the foot of the perpendicular. As the
        mirror moves away the Gouy phase adds 8e-6 of the motion (0.3 nm of 40 um at 920 um).
    """
    away, angle = np.asarray(distance, dtype=float), np.asarray(tilt, dtype=float)
    # Seen from the image of the fibre, twice the distance away along the normal and turned by twice the tilt.
    return coupling(
        2.0 * away * np.cos(angle),
        -2.0 * angle,
        2.0 * away * np.sin(angle),
        mode_field_radius=mode_field_radius,
        wavelength=wavelength,
    )
