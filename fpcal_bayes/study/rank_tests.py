"""Are ranks uniform? Tests of simulation-based calibration (Talts et al. 2018)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

#: Draws among which a truth is ranked; 200 ranks can be split into 20 bins and into the intervals below.
RANKED = 199
BINS = 20
COVERAGES = (0.5, 0.8, 0.95)
FAMILY_WISE = 0.01


@dataclass(frozen=True)
class Verdict:
    """Tests of one quantity: p-values of the ranks' uniformity, and of each interval's coverage.

    Attributes
    ----------
    name
        Of the quantity.
    chi_square, kolmogorov
        p-values of the ranks in bins, and of their distribution.
    covered, coverage
        Share of the ranks in each central interval of `COVERAGES`, and its p-value.
    """

    name: str
    chi_square: float
    kolmogorov: float
    covered: list[float]
    coverage: list[float]


def judge(name: str, ranks: NDArray[np.int64], random: np.random.Generator) -> Verdict:
    """Test the ranks (n_replicates,), 0 to `RANKED`, of one quantity."""
    counts = np.bincount(ranks * BINS // (RANKED + 1), minlength=BINS)
    spread = (ranks + random.random(len(ranks))) / (RANKED + 1)
    covered, p_values = [], []
    for share in COVERAGES:
        tail = (RANKED + 1) * (1 - share) / 2
        inside = int(((ranks >= tail - 1e-9) & (ranks < RANKED + 1 - tail - 1e-9)).sum())
        covered.append(inside / len(ranks))
        p_values.append(float(stats.binomtest(inside, len(ranks), share).pvalue))
    return Verdict(
        name, float(stats.chisquare(counts).pvalue), float(stats.kstest(spread, "uniform").pvalue), covered, p_values
    )


def least_p(verdict: Verdict) -> float:
    """The smallest p-value of the five tests, corrected for their number."""
    return min(1.0, 5.0 * min(verdict.chi_square, verdict.kolmogorov, *verdict.coverage))
