"""Absolute lengths from simulated wavelength scans."""

from dataclasses import replace

import numpy as np
import pytest
from trace_fixtures import scan

from fpcal_bayes.fringes.wavelength_scan import expected_lengths, read_wavelength_scan
from fpcal_bayes.model.air_index import ciddor
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell


def test_lengths_err_as_they_say_and_far_below_an_eighth_wavelength() -> None:
    random = np.random.default_rng(1)
    errors, scores = [], []
    for _ in range(60):
        length = random.normal(920.0, 150.0)
        reading = read_wavelength_scan(scan(random, length), 920.0, 200.0, noise=0.01)
        assert reading.good
        errors.append(reading.length - length)
        scores.append(errors[-1] / reading.sigma)
    assert np.abs(errors).max() < 0.05 < 1.56 / 8
    assert 0.67 < np.mean(np.square(scores)) < 1.4


def test_a_falling_scan_and_air_are_taken_into_account() -> None:
    random = np.random.default_rng(2)
    wavelength = np.linspace(1.6, 1.52, 900)
    index = ciddor(wavelength, 25.0, 1000.0, 50.0)
    signal = 1.5 + np.cos(4.0 * np.pi * index * 930.0 / wavelength) + 0.01 * random.normal(size=900)
    falling = replace(scan(random, 1.0), wavelength=wavelength, irradiance=signal)
    read = read_wavelength_scan(falling, 920.0, 200.0, air=(25.0, 1000.0, 50.0))
    assert read.length == pytest.approx(930.0, abs=5 * read.sigma)
    without = read_wavelength_scan(falling, 920.0, 200.0)
    assert without.length - 930.0 == pytest.approx(930.0 * 2.6e-4, rel=0.05)


def test_scans_that_tell_nothing_are_refused() -> None:
    random = np.random.default_rng(3)
    good = scan(random, 920.0)
    flat = replace(good, irradiance=np.ones(801))
    assert read_wavelength_scan(flat, 920.0, 200.0).refused == "the signal is constant"
    noise = replace(good, irradiance=1.0 + 0.01 * random.normal(size=801))
    assert not read_wavelength_scan(noise, 920.0, 200.0, noise=0.01).good
    clipped = replace(good, irradiance=np.minimum(good.irradiance, 2.0))
    assert "saturated" in read_wavelength_scan(clipped, 920.0, 200.0).refused
    sparse = scan(random, 920.0, 140)
    assert "sparse" in read_wavelength_scan(sparse, 920.0, 200.0).refused


def test_expected_lengths_are_those_of_the_cell(femto: Cell) -> None:
    q = np.zeros((2, 6))
    q[1, 1] = 100.0
    lengths, sds = expected_lengths(femto, q)
    model = CavityModel.of(femto)
    np.testing.assert_allclose(lengths, np.abs(model.predict(model.free.nominal, model.pose_rows(q))), atol=1e-9)
    assert ((sds > 190) & (sds < 260)).all()
