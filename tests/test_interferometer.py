"""The forward model of the interferometer."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import RandomCell, random_cells
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.tables import Interferometer
from fpcal_bayes.model.interferometer import fringe, mirror_amplitude, mirror_views, read_out, reflected

OPTICS = Interferometer(1.56)


@settings(max_examples=15)
@given(random_cells(n_poses=3))
def test_views_agree_with_the_chain(case: RandomCell) -> None:
    length, distance, tilt = mirror_views(case.model, case.values, case.poses)
    np.testing.assert_allclose(length, np.abs(case.lengths), atol=case.tolerance)
    for pose, away, angle in zip(case.poses, distance, tilt, strict=True):
        mirror = chain.mirror_pose(case.cell, case.vector, pose)
        normal, axis = mirror[:3, 2], chain.optical_axis(case.cell, case.vector)
        assert np.cos(angle) == pytest.approx(abs(normal @ axis), abs=1e-12)
        assert away == pytest.approx(abs(normal @ (mirror[:3, 3] - chain.fibre_in_world(case.vector)[:3, 3])), abs=1e-7)


@settings(max_examples=25)
@given(st.floats(300.0, 1500.0), st.floats(0.0, 0.06), st.floats(0.01, 0.5), st.floats(0.1, 1.0))
def test_airy_tends_to_two_beams(distance: float, tilt: float, end: float, mirror: float) -> None:
    """The two differ by the passes after the first, at most 3 r1 s of the fringe."""
    optics = replace(OPTICS, fibre_reflectivity=end, mirror_reflectivity=mirror)
    length = distance + np.linspace(0.0, 1.56, 50)
    two = reflected(optics, length, distance, tilt)
    airy = reflected(replace(optics, beams="airy"), length, distance, tilt)
    amplitude = fringe(optics, distance, tilt)[1]
    small = float(np.sqrt(end) * mirror_amplitude(optics, distance, tilt))
    assert np.abs(airy - two).max() <= 3.0 * small / (1.0 - small) ** 2 * float(amplitude) * (1 + 1e-9)
    assert ((two >= 0) & (airy >= 0) & (airy <= 1)).all()


def test_airy_is_a_sum_over_passes() -> None:
    optics = replace(OPTICS, beams="airy", fibre_reflectivity=0.3)
    end, once = np.sqrt(0.3), float(mirror_amplitude(optics, 100.0, 0.01)) * np.exp(4j * np.pi * 100.1 / 1.56)
    passes = end + sum(0.7 * once * (-end * once) ** k for k in range(60))
    assert reflected(optics, 100.1, 100.0, 0.01) == pytest.approx(abs(passes) ** 2, rel=1e-12)


def test_lossless_plane_cavity_returns_all() -> None:
    optics = replace(OPTICS, beams="airy", fibre_reflectivity=0.5, mirror_reflectivity=1.0, mode_field_radius=1e4)
    np.testing.assert_allclose(reflected(optics, np.linspace(0.0, 2.0, 40), 0.0, 0.0), 1.0)


def test_fringes_fade_with_tilt_and_distance_and_the_maximum_grows_when_aligned() -> None:
    visibility = [float(b / a) for a, b in (fringe(OPTICS, 920.0, t) for t in np.radians([0.0, 1.0, 3.0, 5.0]))]
    assert visibility == sorted(visibility, reverse=True)
    assert visibility[0] > 0.5 > visibility[-1] > 0.05
    mean, amplitude = fringe(OPTICS, 920.0, np.radians([0.0, 1.0, 3.0]))
    assert (np.diff(mean + amplitude) < 0).all()
    assert (np.diff(fringe(OPTICS, np.array([500.0, 900.0, 1300.0]), 0.0)[1]) < 0).all()


def test_default_signal_fits_the_converter() -> None:
    mean, amplitude = fringe(OPTICS, np.array([700.0, 920.0, 1100.0]), 0.0)
    assert (OPTICS.gain * (mean + amplitude) + OPTICS.dark < 0.9 * OPTICS.full_scale).all()
    assert (OPTICS.gain * (mean - amplitude) + OPTICS.dark > 0.0).all()


def test_wavelength_error_multiplies_the_length() -> None:
    """A picometre shifts the phase as 0.6 nm of cavity length do."""
    one = reflected(OPTICS, 920.0, 920.0, 0.0, wavelength=1.56 + 1e-6)
    other = reflected(OPTICS, 920.0 * 1.56 / (1.56 + 1e-6), 920.0, 0.0)
    assert one == pytest.approx(float(other), rel=1e-12)
    assert pytest.approx(0.59e-3, rel=0.01) == 920.0 - 920.0 * 1.56 / (1.56 + 1e-6)


def test_index_of_air_shortens_the_fringe() -> None:
    index = 1.00027
    one = reflected(OPTICS, 920.0 + 1.56 / (2.0 * index), 920.0, 0.0, index=index)
    assert one == pytest.approx(float(reflected(OPTICS, 920.0, 920.0, 0.0, index=index)), rel=1e-9)


def test_converter_has_steps_and_ends() -> None:
    optics = replace(OPTICS, bits=2, full_scale=3.0)
    np.testing.assert_array_equal(read_out(optics, np.array([-1.0, 0.4, 0.6, 1.2, 9.0])), [0.0, 0.0, 1.0, 1.0, 3.0])


def test_views_of_the_built_in_cell(femto) -> None:  # type: ignore[no-untyped-def]
    model = CavityModel.of(femto)
    length, distance, tilt = mirror_views(model, model.free.nominal, np.zeros((1, 6)))
    assert (length[0], distance[0], tilt[0]) == pytest.approx((920.0, 920.0, 0.0), abs=1e-7)
