"""The interferometer forwards: from where the mirror stands to the light that comes back, and to a voltage.

The fibre end reflects a part r1 of the field; the mirror returns the rest, of which the fibre takes back the part that
`mirror_coupling` tells. With s = (coupled amplitude) x sqrt(mirror reflectivity) and d = 4 pi n L / lambda

    two-beam   |r1 + (1 - r1^2) s exp(i d)|^2                        = A + B cos(d)
    airy       |r1 + (1 - r1^2) s exp(i d) / (1 + r1 s exp(i d))|^2     (M. Born, E. Wolf, Principles of Optics, 7.6)

As the mirror tilts or moves away s falls, and the visibility B / A with it. The second harmonic of the airy form is
r1 s of the first: 1 % for a bare fibre at 0.9 mm. L is the length of the cell's path model; the small further phase of
the coupling (see `mirror_coupling`) is left out, as everywhere in the project.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.tables import Interferometer
from fpcal_bayes.model.chain import fibre_in_world, optical_axis

Complexes = NDArray[np.complex128]


def coupling(
    distance: ArrayLike, tilt: ArrayLike, offset: ArrayLike, *, mode_field_radius: float, wavelength: ArrayLike
) -> Complexes:
    """Amplitude of the fibre mode that a beam excites; its square is the share of power. Arguments broadcast; um, rad.

    `distance` is from the beam's waist along the beam, `tilt` its angle with the fibre in the plane of the offset,
    `offset` that of the fibre across it, positive where a positive tilt makes the light arrive later; wavelength in the
    medium.
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
    return np.asarray(size * np.exp(slope**2 / (4.0 * along) - start))


def mirror_coupling(
    distance: ArrayLike, tilt: ArrayLike, *, mode_field_radius: float, wavelength: ArrayLike
) -> Complexes:
    """Amplitude of the fibre mode after one reflection at a plane mirror, without the mirror's reflectivity and phase.

    `distance` is perpendicular to the mirror, in um. Minus the phase over twice the wave number is the length that an
    interferometer sees: it follows `distance` as the mirror tilts, whatever the mode's radius, since the two fields
    overlap around the foot of the perpendicular; as the mirror moves away the Gouy phase adds 8e-6 of the motion.
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


def mirror_views(model: CavityModel, values: Floats, q: Floats) -> tuple[Floats, Floats, Floats]:
    """Cavity length in the cell's path model, perpendicular distance (um) and tilt (rad) at poses (n, n_joints)."""
    vector = model.vector(values)
    fibre, axis = fibre_in_world(vector)[:3, 3], optical_axis(model.cell, vector)
    normals, origins = model.mirrors(values, q)
    distance = np.abs(np.einsum("ij,ij->i", normals, origins - fibre))
    cosine = np.abs(normals @ axis)
    sine = np.linalg.norm(np.cross(normals, axis), axis=1)
    return distance / cosine if model.cell.opd == "axis" else distance, distance, np.arctan2(sine, cosine)


def mirror_amplitude(optics: Interferometer, distance: ArrayLike, tilt: ArrayLike) -> Floats:
    """Amplitude s of the light that comes back into the fibre, at a perpendicular distance (um) and tilt (rad)."""
    taken = mirror_coupling(distance, tilt, mode_field_radius=optics.mode_field_radius, wavelength=optics.wavelength)
    return np.asarray(np.sqrt(optics.mirror_reflectivity) * np.abs(taken))


def fringe(optics: Interferometer, distance: ArrayLike, tilt: ArrayLike) -> tuple[Floats, Floats]:
    """Mean A and amplitude B of the two-beam fringes, as shares of the light, at a distance (um) and tilt (rad)."""
    end, returned = np.sqrt(optics.fibre_reflectivity), mirror_amplitude(optics, distance, tilt)
    passed = (1.0 - optics.fibre_reflectivity) * returned
    return end**2 + passed**2, 2.0 * end * passed


def reflected(
    optics: Interferometer,
    length: ArrayLike,
    distance: ArrayLike,
    tilt: ArrayLike,
    *,
    wavelength: ArrayLike | None = None,
    index: ArrayLike = 1.0,
) -> Floats:
    """Share of the light that comes back at a cavity `length` (um); `wavelength` in vacuum; all arguments broadcast."""
    light = optics.wavelength if wavelength is None else np.asarray(wavelength, dtype=float)
    phase = 4.0 * np.pi * np.asarray(index) * np.asarray(length, dtype=float) / light
    if optics.beams == "two-beam":
        mean, amplitude = fringe(optics, distance, tilt)
        return np.asarray(mean + amplitude * np.cos(phase))
    end, returned = np.sqrt(optics.fibre_reflectivity), mirror_amplitude(optics, distance, tilt)
    once = returned * np.exp(1j * phase)
    return np.asarray(np.abs(end + (1.0 - optics.fibre_reflectivity) * once / (1.0 + end * once)) ** 2)


def read_out(optics: Interferometer, voltage: Floats) -> Floats:
    """What the converter makes of a voltage: whole steps, nothing below zero or above the full scale; same shape."""
    return np.asarray(np.clip(np.rint(voltage / optics.step), 0, 2**optics.bits - 1) * optics.step)
