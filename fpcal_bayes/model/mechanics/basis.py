"""The functions of a joint's value that error motions are made of, and the sizes of a data sheet as their weights.

An unknown function is a sum of basis functions whose weights are independent normal, their standard deviation falling
as 1/k: Legendre polynomials k = 1 to 5 over the travel of a limited joint, harmonics k = 1 to 4 of an endless one. A
size on a sheet is what such a function shows at the median: the factors below are the medians over draws (a test draws
them anew).
"""

from typing import Literal

import numpy as np
from numpy.polynomial import legendre

from fpcal_bayes.core.typing import Floats

Shape = Literal["legendre", "legendre-bent", "fourier", "fourier-beyond-first"]

#: Median peak to valley of a function whose first weight (k = 1) has the standard deviation 1. "bent": its line is
#: not counted (a straightness is measured from the best line); "beyond-first": there is no fundamental.
PEAK_TO_VALLEY: dict[Shape, float] = {
    "legendre": 1.902,
    "legendre-bent": 1.039,
    "fourier": 3.682,
    "fourier-beyond-first": 2.204,
}
#: Highest polynomial and highest harmonic.
LEGENDRE, HARMONICS = 5, 4


def polynomials(q: Floats, low: float | Floats, high: float | Floats) -> Floats:
    """Legendre polynomials 1 to 5 over a travel from `low` to `high`, shape (n, 5); of joints (n, m), (n, m, 5)."""
    x = (2.0 * q - low - high) / (high - low)
    return np.asarray(legendre.legvander(x, LEGENDRE)[..., 1:], dtype=np.float64)


def harmonics(q: Floats) -> Floats:
    """Cosine and sine of one to four turns per turn, cos q, sin q, cos 2q, ..., shape (..., 8): a full turn closes."""
    angles = q[..., None] * np.arange(1, HARMONICS + 1)
    values: Floats = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(*q.shape, 2 * HARMONICS)
    return values


def weight_sd(size: float, shape: Shape) -> Floats:
    """Standard deviations by k of the weights of a function of peak to valley `size`, shape (5,) or (4,)."""
    count = LEGENDRE if shape.startswith("legendre") else HARMONICS
    sd: Floats = size / PEAK_TO_VALLEY[shape] / np.arange(1, count + 1)
    if shape == "fourier-beyond-first":
        sd[0] = 0.0
    return sd
