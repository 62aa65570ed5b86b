"""Height and phase of the fringes from a scan whose changes of length are known."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats

#: Below this many standard deviations an amplitude is no fringe.
_CLEAR = 10.0


@dataclass(frozen=True)
class FringeFit:
    """Irradiance A + C cos(k x) - S sin(k x) = A + B cos(k x + phase) against a change x of the cavity length."""

    wave_number: float  # k = 4 pi n / lambda, in rad per um of cavity length
    coefficients: Floats  # A, C and S in V, shape (3,)
    covariance: Floats  # of these, shape (3, 3)
    noise: float  # standard deviation of a sample, in V

    @property
    def mean(self) -> float:
        """A, in V."""
        return float(self.coefficients[0])

    @property
    def amplitude(self) -> float:
        """B, in V."""
        return float(np.hypot(*self.coefficients[1:]))

    @property
    def phase(self) -> float:
        """Phase at x = 0, in rad."""
        return float(np.arctan2(self.coefficients[2], self.coefficients[1]))

    def to_quadrature(self, low: float = -np.inf, high: float = np.inf) -> float:
        """The smallest change of cavity length in um, from low to high, that leads to half fringe height."""
        around = np.arange(-4, 5) + np.round(self.phase / np.pi)
        places = ((around + 0.5) * np.pi - self.phase) / self.wave_number
        places = places[(places >= low) & (places <= high)]
        if not len(places):
            raise InputError("no point at half fringe height within the joint's limits")
        return float(places[np.argmin(np.abs(places))])


def fit_fringe(change: Floats, irradiance: Floats, wavelength: float) -> FringeFit:
    """Fit mean, amplitude and phase to irradiance in V (n,) for changes of the cavity length in um (n,)."""
    wave_number = 4.0 * np.pi / wavelength
    if len(change) < 4 or np.ptp(change) < 0.75 * wavelength / 2.0:
        raise InputError(
            f"a reference scan of {len(change)} samples over {1e3 * float(np.ptp(change)):.0f} nm: expected three "
            f"quarters of a fringe ({375 * wavelength:.0f} nm) or more"
        )
    phase = wave_number * change
    basis = np.column_stack([np.ones_like(phase), np.cos(phase), -np.sin(phase)])
    coefficients, *_ = np.linalg.lstsq(basis, irradiance)
    left = irradiance - basis @ coefficients
    variance = float(left @ left) / (len(left) - 3)
    fit = FringeFit(wave_number, coefficients, variance * np.linalg.inv(basis.T @ basis), float(np.sqrt(variance)))
    if fit.amplitude <= _CLEAR * float(np.sqrt(np.diag(fit.covariance)[1:].max())):
        raise InputError(
            f"the reference scan shows no fringe: amplitude {fit.amplitude:.3g} V, noise {fit.noise:.3g} V"
        )
    return fit
