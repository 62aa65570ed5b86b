"""Refractive index of air: P. E. Ciddor, Applied Optics 35, 1566 (1996), with its saturation vapour pressure.

Of wavelengths from 0.3 to 1.7 um its stated uncertainty is a few parts in 1e8 under laboratory conditions: 0.05 nm on
a cavity of 1 mm. Light in air has the wavelength lambda / n, so that a phase of 4 pi n L / lambda tells the length L.
"""

import numpy as np
from numpy.typing import ArrayLike

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats

#: Ranges in which the formula is used: wavelength in um, temperature in C, pressure in hPa, relative humidity in %.
RANGES = {
    "wavelength": (0.3, 1.7, "um"),
    "temperature": (-40.0, 100.0, "C"),
    "pressure": (600.0, 1200.0, "hPa"),
    "humidity": (0.0, 100.0, "%"),
}

_GAS_CONSTANT = 8.314510
_ZERO_CELSIUS = 273.15


def ciddor(wavelength: ArrayLike, temperature_c: ArrayLike, pressure_hpa: ArrayLike, humidity_pct: ArrayLike) -> Floats:
    """Phase index of moist air, 450 ppm CO2; wavelength in vacuum in um, relative humidity; all arguments broadcast."""
    given = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (wavelength, temperature_c, pressure_hpa)))
    humidity = np.asarray(humidity_pct, dtype=float)
    for value, (name, (low, high, unit)) in zip((*given, humidity), RANGES.items(), strict=True):
        bad = ~((value >= low) & (value <= high))
        if bad.any():
            raise InputError(f"air: {name} {value[bad].flat[0]:g} {unit}: expected {low:g} to {high:g} {unit}")
    light, celsius, pressure = given[0], given[1], 100.0 * given[2]
    # Molar fraction of water vapour.
    kelvin = celsius + _ZERO_CELSIUS
    over_water = np.exp(1.2378847e-5 * kelvin**2 - 1.9121316e-2 * kelvin + 33.93711047 - 6.3431645e3 / kelvin)
    over_ice = 10.0 ** (12.537 - 2663.5 / kelvin)
    enhancement = 1.00062 + 3.14e-8 * pressure + 5.6e-7 * celsius**2
    vapour = enhancement * (humidity / 100.0) * np.where(celsius >= 0.0, over_water, over_ice) / pressure

    square = light**-2.0
    dry = 1e-8 * (5792105.0 / (238.0185 - square) + 167917.0 / (57.362 - square))
    wet = 1.022e-8 * (295.235 + 2.6422 * square - 0.032380 * square**2 + 0.004028 * square**3)
    # Amounts relative to those at which the two formulas hold: dry air at 15 C, 1013.25 hPa; vapour at 20 C, 13.33 hPa.
    moles = pressure / (_compressibility(celsius, pressure, vapour) * _GAS_CONSTANT * (celsius + _ZERO_CELSIUS))
    dry_standard = 101325.0 / (_compressibility(15.0, 101325.0, 0.0) * _GAS_CONSTANT * (15.0 + _ZERO_CELSIUS))
    wet_standard = 1333.0 / (_compressibility(20.0, 1333.0, 1.0) * _GAS_CONSTANT * (20.0 + _ZERO_CELSIUS))
    # Molar masses are the same above and below the fraction line, so moles stand for densities.
    return np.asarray(1.0 + moles * ((1.0 - vapour) * dry / dry_standard + vapour * wet / wet_standard))


def air_index(
    wavelength: ArrayLike, temperature_c: ArrayLike, pressure_hpa: ArrayLike, humidity_pct: ArrayLike
) -> Floats:
    """The index by `ciddor`, and 1 where temperature, pressure or humidity is unknown (NaN)."""
    light, celsius, pressure, humidity = np.broadcast_arrays(
        *(np.asarray(v, dtype=float) for v in (wavelength, temperature_c, pressure_hpa, humidity_pct))
    )
    known = np.isfinite(celsius) & np.isfinite(pressure) & np.isfinite(humidity)
    index = np.ones(light.shape)
    if known.any():
        index[known] = ciddor(light[known], celsius[known], pressure[known], humidity[known])
    return index


def _compressibility(celsius: ArrayLike, pressure: ArrayLike, vapour: ArrayLike) -> Floats:
    """Compressibility of moist air (Davis 1992), pressure in Pa."""
    t, x = np.asarray(celsius, dtype=float), np.asarray(vapour, dtype=float)
    ratio = np.asarray(pressure, dtype=float) / (t + _ZERO_CELSIUS)
    linear = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t**2
    linear = linear + (5.707e-6 - 2.051e-8 * t) * x + (1.9898e-4 - 2.376e-6 * t) * x**2
    return np.asarray(1.0 - ratio * linear + ratio**2 * (1.83e-11 - 0.765e-8 * x**2))
