"""The one table that turns the words of a data sheet into prior standard deviations of weights.

An unknown function is a sum of basis functions whose weights are independent normal, their standard deviation falling
as 1/k: Legendre polynomials k = 1 to 5 over the travel of a limited joint, harmonics k = 1 to 4 of an endless one. A
size on a sheet is what such a function shows at the median: the factors below are the medians over draws (a test draws
them anew).
"""

from typing import Literal

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats

Word = Literal["peak-to-valley", "plus-minus", "rms", "percent-of-travel", "unidirectional", "bidirectional"]
Shape = Literal["legendre", "legendre-bent", "fourier", "fourier-beyond-first"]

#: Median peak to valley of a function whose first weight (k = 1) has the standard deviation 1. "bent": its line is
#: not counted (a straightness is measured from the best line); "beyond-first": there is no fundamental.
PEAK_TO_VALLEY: dict[Shape, float] = {
    "legendre": 1.902,
    "legendre-bent": 1.039,
    "fourier": 3.682,
    "fourier-beyond-first": 2.204,
}
#: Peak to valley over root mean square of such functions, at the median.
CREST: dict[Shape, float] = {
    "legendre": 3.74,
    "legendre-bent": 4.38,
    "fourier": 3.43,
    "fourier-beyond-first": 3.67,
}
#: Highest polynomial and highest harmonic.
LEGENDRE, HARMONICS = 5, 4


def peak_to_valley(word: Word, value: float, *, travel: float = 0.0, shape: Shape = "legendre") -> float:
    """Peak to valley that a statement stands for, in the unit of the statement.

    word: ``peak-to-valley``, ``plus-minus`` (half of it, as runout and wobble are stated), ``rms``,
    ``percent-of-travel`` (of `travel`, in the unit wanted), or for the two repeatabilities ``unidirectional`` and
    ``bidirectional`` see `return_sd` and `reversal`.
    value: as stated.
    """
    if word == "peak-to-valley":
        return value
    if word == "plus-minus":
        return 2.0 * value
    if word == "rms":
        return CREST[shape] * value
    if word == "percent-of-travel":
        return value / 100.0 * travel
    raise InputError(f"{word!r} says nothing of a function along the travel")


def return_sd(word: Word, value: float) -> float:
    """Standard deviation of the return error: ISO 230-2 states a unidirectional repeatability of four of them."""
    if word == "rms":
        return value
    if word == "plus-minus":
        return value / 2.0
    if word == "unidirectional":
        return value / 4.0
    raise InputError(f"{word!r} says nothing of the return to a position from one side")


def reversal(word: Word, value: float, *, unidirectional: float = 0.0) -> float:
    """Lost motion on reversal: what a bidirectional repeatability has beyond the unidirectional one (ISO 230-2)."""
    if word == "peak-to-valley":
        return value
    if word == "plus-minus":
        return 2.0 * value
    if word == "bidirectional":
        return max(value - unidirectional, 0.0)
    raise InputError(f"{word!r} says nothing of the direction of approach")


def weight_sd(size: float, shape: Shape) -> Floats:
    """Standard deviations of the weights of one function of peak to valley `size`.

    Returns by k, shape (5,) or (4,); zero for a fundamental that is not there.
    """
    count = LEGENDRE if shape.startswith("legendre") else HARMONICS
    sd: Floats = size / PEAK_TO_VALLEY[shape] / np.arange(1, count + 1)
    if shape == "fourier-beyond-first":
        sd[0] = 0.0
    return sd
