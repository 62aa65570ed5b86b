"""The index of air against Ciddor's own tables (Applied Optics 35, 1566 (1996)) and the modified Edlen formula."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model.air_index import air_index, ciddor

# Table 1, dry air, and Table 3, moist air, at 633 nm: temperature, pressure in hPa, humidity, 1e8 (n - 1).
# One entry of Table 3 (40 C, 800 hPa) is misprinted by 100 in the paper and is left out.
TABLES = [
    (20.0, 800.0, 0.0, 21458.0),
    (20.0, 1000.0, 0.0, 26824.4),
    (20.0, 1200.0, 0.0, 32191.6),
    (10.0, 1000.0, 0.0, 27774.7),
    (30.0, 1000.0, 0.0, 25937.2),
    (20.0, 800.0, 75.0, 21394.0),
    (20.0, 1200.0, 75.0, 32127.8),
    (40.0, 1200.0, 75.0, 29941.8),
    (50.0, 800.0, 100.0, 19058.4),
    (50.0, 1200.0, 100.0, 28792.4),
]


def test_published_tables_are_met() -> None:
    celsius, pressure, humidity, expected = np.array(TABLES).T
    np.testing.assert_allclose(1e8 * (ciddor(0.633, celsius, pressure, humidity) - 1.0), expected, atol=0.1)


@pytest.mark.parametrize(
    ("celsius", "pressure", "wavelength", "expected"),
    # Test values of the NIST calculator; dry air, and moist air at 40 C.
    [(20.0, 1013.25, 1.7, 1.000268479), (-40.0, 1000.0, 0.633, 1.000337580), (20.0, 1013.25, 0.3, 1.000286581)],
)
def test_nist_values_are_met(celsius: float, pressure: float, wavelength: float, expected: float) -> None:
    assert ciddor(wavelength, celsius, pressure, 0.0) == pytest.approx(expected, abs=1.5e-9)


@settings(max_examples=25)
@given(st.floats(10.0, 35.0), st.floats(700.0, 1100.0), st.floats(0.0, 80.0), st.floats(0.4, 0.65))
def test_edlens_formula_agrees(celsius: float, pressure: float, humidity: float, wavelength: float) -> None:
    """Birch and Downs, Metrologia 31, 315 (1994): another dispersion, another density law."""
    square, pascal = wavelength**-2, 100.0 * pressure
    dry = 1e-8 * (8342.54 + 2406147.0 / (130.0 - square) + 15998.0 / (38.9 - square))
    density = 1.0 + 1e-8 * (0.601 - 0.00972 * celsius) * pascal
    dry *= pascal * density / (96095.43 * (1.0 + 0.0036610 * celsius))
    # Magnus' formula for the vapour pressure is good to half a percent here.
    vapour = humidity / 100.0 * 611.2 * np.exp(17.62 * celsius / (243.12 + celsius))
    edlen = 1.0 + dry - vapour * (3.7345 - 0.0401 * square) * 1e-10
    # Their ranges of use end at different humidities; a hundredth of the vapour's own share is allowed for.
    assert ciddor(wavelength, celsius, pressure, humidity) == pytest.approx(edlen, abs=3e-8 + 0.03e-10 * vapour * 3.7)


def test_unknown_conditions_are_vacuum() -> None:
    index = air_index([1.56, 1.56], [20.0, np.nan], 1013.25, 50.0)
    assert index[1] == 1.0
    assert index[0] == ciddor(1.56, 20.0, 1013.25, 50.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.56, 20.0, 1013.25, 101.0), "humidity 101 %: expected 0 to 100 %"),
        ((1.56, 20.0, 101325.0, 50.0), "pressure 101325 hPa: expected 600 to 1200 hPa"),
        ((1560.0, 20.0, 1013.25, 50.0), "wavelength 1560 um"),
        ((1.56, np.nan, 1013.25, 50.0), "temperature nan C"),
    ],
)
def test_values_out_of_range_are_refused(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ciddor(*arguments)
