"""Measures of what sweeps can tell: bounds, observability indices, and base parameters with what is regrouped."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import posterior_triangle
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.spectrum import Spectrum, spectrum_of
from fpcal_bayes.model.parameters import ParameterSet


@dataclass(frozen=True)
class Bounds:
    """Least standard deviations of the parameters, in prior standard deviations."""

    # of any unbiased estimate, without prior (Cramer 1946, Rao 1945); infinite where a direction that the data do not
    # see takes part. Shape (n,).
    unbiased: Floats
    with_prior: Floats  # of any estimate on average over the prior (van Trees 1968), shape (n,)


def bounds_of(jacobian: Floats) -> Bounds:
    """Bounds for the parameters of a whitened, prior-scaled Jacobian (n_rows, n); the others are known exactly."""
    spectrum = spectrum_of(jacobian)
    seen, rank = spectrum.singular_values, spectrum.rank
    unbiased = np.sqrt(((spectrum.observable / seen[:rank, None]) ** 2).sum(axis=0))
    # Rounding gives every parameter a share of about 1e-13 in the null space.
    unbiased[spectrum.null_share > 1e-12] = np.inf
    inverse = linalg.solve_triangular(posterior_triangle(jacobian), np.eye(jacobian.shape[1]))
    return Bounds(unbiased, np.linalg.norm(inverse, axis=1))


@dataclass(frozen=True)
class Indices:
    """Observability indices over the directions that the data see; larger is better for all five.

    All are formed from the same singular values s_1 >= ... >= s_r: those of the whitened Jacobian in prior standard
    deviations, r being the numerical rank. Directions that no sweep sees are left out, else all indices would be zero.
    """

    o1: float  # geometric mean of s over the root of the number of rows (Borm and Menq 1989, 1991)
    o2: float  # s_r / s_1, the inverse condition number (Driels and Pathre 1990)
    o3: float  # s_r (Nahvi, Hollerbach and Hayward 1994)
    o4: float  # s_r^2 / s_1, the noise amplification index (Nahvi and Hollerbach 1996)
    o5: float  # 1 / sum of 1 / s (Sun and Hollerbach 2008)
    condition: float  # s_1 / s_r

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


#: A share of another parameter below this is rounding.
_LEAST_SHARE = 1e-6


@dataclass(frozen=True)
class BaseParameter:
    """One base parameter: a parameter plus fixed shares of others."""

    name: str  # the parameter that is kept
    # what is regrouped into it: (name, factor in shown units). The data see ``name + sum of factor * other``.
    shares: tuple[tuple[str, float], ...]

    def content(self) -> dict[str, object]:
        """For JSON."""
        return {"name": self.name, "regrouped": [{"name": name, "factor": factor} for name, factor in self.shares]}

    def __str__(self) -> str:
        return self.name + "".join(f" {factor:+.4g} {name}" for name, factor in self.shares)


def pivots_of(rows: Floats) -> list[int]:
    """A column of independent `rows` (k, n) each, by column pivoting; among equals, within rounding, the first wins."""
    reduced, chosen = rows.copy(), []
    for _ in range(len(rows)):
        size = np.linalg.norm(reduced, axis=0)
        column = int(np.flatnonzero(size >= (1 - 1e-6) * size.max())[0])
        chosen.append(column)
        unit = reduced[:, column] / size[column]
        reduced = reduced - np.outer(unit, unit @ reduced)
    return chosen


def base_parameters(spectrum: Spectrum, parameters: ParameterSet) -> tuple[BaseParameter, ...]:
    """As many base parameters as the rank, by QR with column pivoting (Gautier 1991), in prior-scaled units."""
    rank = spectrum.rank
    if rank == 0:
        return ()
    # Only directions count, not how well each is seen: weak combinations are base parameters too.
    directions = spectrum.observable
    kept = sorted(pivots_of(directions))
    others = [i for i in range(len(parameters)) if i not in kept]
    factors = linalg.solve(directions[:, kept], directions[:, others]).reshape(rank, len(others))
    unit_of = parameters.to_shown(parameters.prior_sd)
    found = []
    for row, column in enumerate(kept):
        shares = tuple(
            (parameters.names[other], float(factors[row, i] * unit_of[column] / unit_of[other]))
            for i, other in enumerate(others)
            if abs(factors[row, i]) > _LEAST_SHARE
        )
        found.append(BaseParameter(parameters.names[column], shares))
    return tuple(found)
