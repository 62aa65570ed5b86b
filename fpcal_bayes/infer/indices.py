"""Observability indices O1 to O5 of a set of sweeps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.infer.observability import Spectrum

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Indices:
    """Observability indices over the directions that the data see; larger is better for all five.

    All are formed from the same singular values s_1 >= ... >= s_r: those of the whitened Jacobian in prior standard
    deviations, r being the numerical rank. Directions that no sweep sees are left out, else all indices would be zero.

    Attributes
    ----------
    o1
        Geometric mean of s over the root of the number of rows (Borm and Menq 1989, 1991).
    o2
        s_r / s_1, the inverse condition number (Driels and Pathre 1990).
    o3
        s_r (Nahvi, Hollerbach and Hayward 1994).
    o4
        s_r^2 / s_1, the noise amplification index (Nahvi and Hollerbach 1996).
    o5
        1 / sum of 1 / s (Sun and Hollerbach 2008).
    condition
        s_1 / s_r.
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float
    condition: float

    def content(self) -> dict[str, float]:
        """The five indices, for JSON."""
        return {"O1": self.o1, "O2": self.o2, "O3": self.o3, "O4": self.o4, "O5": self.o5}


def indices_of(spectrum: Spectrum, n_rows: int) -> Indices:
    """Observability indices of a spectrum from `n_rows` rows; all zero if nothing is seen."""
    seen = spectrum.singular_values[: spectrum.rank]
    if not len(seen):
        return Indices(0.0, 0.0, 0.0, 0.0, 0.0, float("inf"))
    largest, smallest = float(seen[0]), float(seen[-1])
    return Indices(
        o1=float(np.exp(np.log(seen).mean()) / np.sqrt(n_rows)),
        o2=smallest / largest,
        o3=smallest,
        o4=smallest**2 / largest,
        o5=float(1.0 / (1.0 / seen).sum()),
        condition=largest / smallest,
    )
