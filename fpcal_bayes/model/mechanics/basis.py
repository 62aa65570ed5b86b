"""The functions of a joint's value that error motions are made of."""

import numpy as np
from numpy.polynomial import legendre

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.mechanics.words import HARMONICS, LEGENDRE


def polynomials(q: Floats, low: float, high: float) -> Floats:
    """Legendre polynomials 1 to 5 over a travel from `low` to `high`, shape (n, 5)."""
    x = (2.0 * q - low - high) / (high - low)
    return np.asarray(legendre.legvander(x, LEGENDRE)[:, 1:], dtype=np.float64)


def harmonics(q: Floats) -> Floats:
    """Cosine and sine of one to four turns per turn, shape (n, 8): cos q, sin q, cos 2q, ...

    There is no linear term: a full turn closes.
    """
    angles = q[:, None] * np.arange(1, HARMONICS + 1)
    values: Floats = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(q), -1)
    return values
