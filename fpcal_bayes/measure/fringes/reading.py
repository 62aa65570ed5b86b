"""What a trace says of its sweep."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.measure.fringes.course import legendre
from fpcal_bayes.measure.fringes.fit import Fit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """The change of cavity length along one sweep, and how far to trust it.

    Attributes
    ----------
    label
        Of the sweep.
    dl, sigma
        Change from start to end and its standard deviation, in um; NaN where the trace was refused.
    signed
        Whether the sign of `dl` is known; else `dl` is a size.
    sign_source
        Who told the sign, or empty.
    fringes
        That passed, those that passed back included.
    turns
        Places s on the sweep, from -1 to 1, at which L turns.
    reversals
        Joint positions of the same, in um or rad.
    refused
        Why the trace gives no number at all; empty where it gives one.
    doubt
        Why the number is not to be relied on; empty where it is.
    alternatives
        Other changes, in um, that the trace allows.
    samples_a_fringe
        On average, while the joint moves.
    noise, amplitude
        Standard deviation of one sample and mean amplitude of the fringes, in V.
    course, course_covariance
        L less its mean along the sweep: Legendre coefficients in um, see `course`; of the sign of `dl`.
    wavelength_share
        Relative standard deviation of wavelength over index, which scales all changes alike; part of `sigma`.
    fit, phase_per_um
        What was fitted and its 4 pi n / wavelength, for figures; None where refused.
    """

    label: str
    dl: float = np.nan
    sigma: float = np.nan
    signed: bool = False
    sign_source: str = ""
    fringes: float = np.nan
    turns: tuple[float, ...] = ()
    reversals: tuple[float, ...] = ()
    refused: str = ""
    doubt: str = ""
    alternatives: tuple[float, ...] = ()
    samples_a_fringe: float = np.nan
    noise: float = np.nan
    amplitude: float = np.nan
    course: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    course_covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    wavelength_share: float = 0.0
    fit: Fit | None = field(default=None, repr=False)
    phase_per_um: float = np.nan

    @property
    def good(self) -> bool:
        """Whether the number may be used."""
        return not self.refused and not self.doubt

    def changes(self, s: Floats) -> tuple[Floats, Floats]:
        """Changes of L from the start to places on the sweep, with their full covariance.

        Parameters
        ----------
        s
            Places from -1 (start) to 1 (end), shape (n,).

        Returns
        -------
        tuple of ndarray
            In um, shape (n,), and um^2, shape (n, n). All samples tell every change, so they are strongly correlated.
        """
        rows = legendre(s)[:, 1:] - legendre(np.array([-1.0]))[:, 1:]
        changes = rows @ self.course
        covariance = rows @ self.course_covariance @ rows.T + self.wavelength_share**2 * np.outer(changes, changes)
        return changes, covariance

    def grouped(self, points: int) -> tuple[Floats, Floats, float]:
        """Changes to evenly spaced interior points and to the end, as rows that share the reading at their start.

        The campaign's groups have equal variances and correlation 1/2. The standard deviation given is the least for
        which such a covariance is nowhere below the true one: rows of the group then never claim more than is known.

        Parameters
        ----------
        points
            Interior points.

        Returns
        -------
        tuple
            Places s (points + 1,), changes in um (points + 1,), standard deviation of each row in um.
        """
        s = np.linspace(-1.0, 1.0, points + 2)[1:]
        changes, covariance = self.changes(s)
        shape = 0.5 * (np.eye(len(s)) + 1.0)
        root = np.linalg.inv(np.linalg.cholesky(shape))
        largest = np.linalg.eigvalsh(root @ covariance @ root.T)[-1]
        return s, changes, float(np.sqrt(max(largest, self.sigma**2)))
