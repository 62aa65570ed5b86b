"""Coupling in closed form against the overlap integral on a grid, and against its limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.model.interferometer import coupling, mirror_coupling

LIGHT = 1.56
WAVE_NUMBER = 2.0 * np.pi / LIGHT


def overlap(radius: float, distance: float, tilt: float) -> complex:
    """Overlap of the mode with the exact Gaussian beam of the fibre's image, summed over a grid."""
    normal, axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)]), np.array([0.0, 0.0, 1.0])
    image, direction = 2.0 * distance * normal, axis - 2.0 * np.cos(tilt) * normal
    line = np.linspace(-4.0 * radius, 4.0 * radius, 161)
    x, y = np.meshgrid(line, line, indexing="ij")
    away = np.stack([x, y, np.zeros_like(x)], axis=-1) - image
    along = away @ direction
    across = (away**2).sum(axis=-1) - along**2
    rayleigh = WAVE_NUMBER * radius**2 / 2.0
    curve = along + 1j * rayleigh
    beam = 1j * rayleigh / curve * np.exp(-1j * WAVE_NUMBER * (along + across / (2.0 * curve)))
    mode = np.exp(-(x**2 + y**2) / radius**2)
    return complex(2.0 / (np.pi * radius**2) * (beam * mode).sum() * (line[1] - line[0]) ** 2)


@pytest.mark.parametrize("radius", [5.2, 10.0])
@pytest.mark.parametrize("degrees", [0.0, 1.0, 3.0, 5.0])
def test_coupling_is_the_overlap_integral(radius: float, degrees: float) -> None:
    found = complex(mirror_coupling(900.0, np.radians(degrees), mode_field_radius=radius, wavelength=LIGHT))
    expected = overlap(radius, 900.0, np.radians(degrees))
    largest = abs(overlap(radius, 900.0, 0.0))
    assert abs(found) == pytest.approx(abs(expected), abs=3e-3 * largest)
    if abs(expected) > 1e-2 * largest:
        # A hundredth of a nanometre of path.
        assert abs(np.angle(found / expected)) < 2 * WAVE_NUMBER * 1e-5


def test_mode_on_itself_couples_wholly() -> None:
    assert complex(coupling(0.0, 0.0, 0.0, mode_field_radius=5.2, wavelength=LIGHT)) == pytest.approx(1.0)


@settings(max_examples=25)
@given(st.floats(0.0, 2000.0), st.floats(2.0, 50.0))
def test_distance_alone(distance: float, radius: float) -> None:
    """Power over a gap z between equal modes is 1 / (1 + (z / 2 z_R)^2) (Saleh and Teich)."""
    rayleigh = np.pi * radius**2 / LIGHT
    found = abs(complex(coupling(distance, 0.0, 0.0, mode_field_radius=radius, wavelength=LIGHT))) ** 2
    assert found == pytest.approx(1.0 / (1.0 + (distance / (2.0 * rayleigh)) ** 2))


@settings(max_examples=25)
@given(st.floats(-10.0, 10.0), st.floats(-0.02, 0.02))
def test_offset_and_small_tilt_alone(offset: float, tilt: float) -> None:
    """Marcuse 1977: exp(-(offset / w)^2) and exp(-(pi w tilt / lambda)^2) of the power."""
    radius = 5.2
    aside = abs(complex(coupling(0.0, 0.0, offset, mode_field_radius=radius, wavelength=LIGHT))) ** 2
    turned = abs(complex(coupling(0.0, tilt, 0.0, mode_field_radius=radius, wavelength=LIGHT))) ** 2
    assert aside == pytest.approx(np.exp(-((offset / radius) ** 2)))
    assert turned == pytest.approx(np.exp(-((np.pi * radius * tilt / LIGHT) ** 2)), rel=1e-3)


@settings(max_examples=25)
@given(st.floats(-0.05, 0.05), st.floats(300.0, 1500.0))
def test_coupling_is_even_in_tilt_and_falls_with_it(tilt: float, distance: float) -> None:
    angles = np.array([tilt, -tilt, 1.5 * tilt])
    plus, minus, more = np.abs(mirror_coupling(distance, angles, mode_field_radius=5.2, wavelength=LIGHT))
    assert plus == pytest.approx(minus, rel=1e-12)
    assert more <= plus


@pytest.mark.parametrize("radius", [5.2, 20.0, 100.0])
def test_path_follows_the_perpendicular(radius: float) -> None:
    """The mirror turns about the point where the fibre's axis meets it: length along the axis stays."""
    tilt = np.linspace(0.0, np.radians(0.5), 500)
    field = mirror_coupling(920.0 * np.cos(tilt), tilt, mode_field_radius=radius, wavelength=LIGHT)
    path = -np.unwrap(np.angle(field)) / (2.0 * WAVE_NUMBER)
    np.testing.assert_allclose(path - path[0], 920.0 * (np.cos(tilt) - 1.0), atol=2e-6)
