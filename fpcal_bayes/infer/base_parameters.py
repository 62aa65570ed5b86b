"""Base parameters: a smallest set that the data can identify, and what is regrouped into each of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fpcal_bayes.infer.observability import Spectrum
from fpcal_bayes.model.parameters import ParameterSet

Floats = NDArray[np.float64]

#: A share of another parameter below this is rounding.
_LEAST_SHARE = 1e-6


@dataclass(frozen=True)
class BaseParameter:
    """One base parameter: a parameter plus fixed shares of others.

    Attributes
    ----------
    name
        The parameter that is kept.
    shares
        What is regrouped into it: (name, factor in shown units). The data see ``name + sum of factor * other``.
    """

    name: str
    shares: tuple[tuple[str, float], ...]

    def content(self) -> dict[str, object]:
        """For JSON."""
        return {"name": self.name, "regrouped": [{"name": name, "factor": factor} for name, factor in self.shares]}

    def __str__(self) -> str:
        return self.name + "".join(f" {factor:+.4g} {name}" for name, factor in self.shares)


def base_parameters(spectrum: Spectrum, parameters: ParameterSet) -> tuple[BaseParameter, ...]:
    """Choose base parameters by QR with column pivoting (Gautier 1991), in prior-scaled units.

    The order of the rows does not matter, since only the spectrum enters, nor do units, since parameters are in prior
    standard deviations; among columns of equal size the first parameter is kept.

    Returns
    -------
    tuple of BaseParameter
        As many as the rank, in the order of the parameters.
    """
    rank = spectrum.rank
    if rank == 0:
        return ()
    # Only directions count, not how well each is seen: weak combinations are base parameters too.
    directions = spectrum.observable
    reduced, kept = directions.copy(), []
    for _ in range(rank):
        size = np.linalg.norm(reduced, axis=0)
        column = int(np.flatnonzero(size >= (1 - 1e-6) * size.max())[0])
        kept.append(column)
        unit = reduced[:, column] / size[column]
        reduced = reduced - np.outer(unit, unit @ reduced)
    kept.sort()
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
