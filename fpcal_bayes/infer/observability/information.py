"""What each sweep tells: leverage, redundancy, growth of the information, and the worth of further sweeps.

Information is in bits: half the binary logarithm of how far a sweep shrinks the volume of the posterior.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import posterior_triangle
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.sharing import Sharing
from fpcal_bayes.measure.sweeps import Sweeps

#: A sweep is redundant if leaving it out costs less than this.
REDUNDANT_BITS = 0.1
_MOST_POINTS = 200


@dataclass(frozen=True, repr=False)
class Information(Brief):
    """Information of sweeps, one entry a sweep; rows of a group, or read at one moment, are one sweep."""

    labels: tuple[str, ...]
    leverage: Floats  # share of its own measurement in a sweep's fitted value, summed over its rows, shape (n_sweeps,)
    bits: Floats  # information lost if the sweep is left out, shape (n_sweeps,)
    # cumulative_rows, cumulative_bits: information of the first so many rows
    cumulative_rows: Ints
    cumulative_bits: Floats

    @property
    def redundant(self) -> list[str]:
        """Labels of the sweeps that tell less than `REDUNDANT_BITS` beyond the others."""
        return [label for label, bits in zip(self.labels, self.bits, strict=True) if bits < REDUNDANT_BITS]


def information_of(jacobian: Floats, sweeps: Sweeps) -> Information:
    """Information of each sweep from the whitened, prior-scaled Jacobian (n_rows, n)."""
    # Rows of H = J (J'J + I)^-1 J' are inner products of these.
    spread = linalg.solve_triangular(posterior_triangle(jacobian), jacobian.T, trans="T").T
    leverage = (spread**2).sum(axis=1)
    bits = -0.5 * np.log2(np.clip(1.0 - leverage, 1e-300, None))
    first = np.ones(len(jacobian), dtype=bool)
    labels = sweeps.label.tolist()
    for members in Sharing.of(sweeps).blocks:
        block = np.eye(len(members)) - spread[members] @ spread[members].T
        bits[members[0]] = -0.5 * np.linalg.slogdet(block)[1] / np.log(2.0)
        leverage[members[0]] = leverage[members].sum()
        labels[members[0]] = str(sweeps.group[members[0]] or sweeps.label[members[0]])
        first[members[1:]] = False
    rows, cumulative = cumulative_bits(jacobian)
    chosen = np.flatnonzero(first)
    return Information(tuple(labels[i] for i in chosen), leverage[chosen], bits[chosen], rows, cumulative)


def cumulative_bits(jacobian: Floats) -> tuple[Ints, Floats]:
    """Information of the first so many rows, at up to 200 counts; whitening takes rows of a group in their order."""
    n_rows, n = jacobian.shape
    counts = np.unique(np.linspace(0, n_rows, min(n_rows, _MOST_POINTS) + 1).astype(np.int64))
    precision, bits = np.eye(n), [0.0]
    for start, stop in pairwise(counts.tolist()):
        precision = precision + jacobian[start:stop].T @ jacobian[start:stop]
        bits.append(0.5 * float(np.linalg.slogdet(precision)[1]) / np.log(2.0))
    return counts, np.array(bits)


def gain_of(jacobian: Floats, candidates: Floats) -> Floats:
    """Information in bits (n_candidates,) that each row would add, from whitened, prior-scaled derivatives (.., n)."""
    spread = linalg.solve_triangular(posterior_triangle(jacobian), candidates.T, trans="T")
    return 0.5 * np.log2(1.0 + (spread**2).sum(axis=0))
