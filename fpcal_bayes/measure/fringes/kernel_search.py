"""Search for the course of a fringe signal, compiled."""

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.model.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@compiled
def turned_bins(
    signal: Floats, place: Ints, base: Floats, bend: Floats, bends: Floats, n_bins: int
) -> NDArray[np.complex128]:
    """Signal turned back by the phase of each bend and summed into bins.

    Parameters
    ----------
    signal, place
        Weighted signal and the bin of each sample, shape (n,).
    base, bend
        Known phase, and phase a unit of bend, shape (n,).
    bends
        Bends tried, shape (m,).

    Returns
    -------
    ndarray
        Shape (m, n_bins): its Fourier transform along the bins tells how well each slope fits.
    """
    bins = np.zeros((bends.size, n_bins), dtype=np.complex128)
    for i in range(bends.size):
        for k in range(signal.size):
            f = base[k] + bends[i] * bend[k]
            bins[i, place[k]] += signal[k] * complex(np.cos(f), -np.sin(f))
    return bins


@compiled
def floating_fits(
    s: Floats, signal: Floats, weight: Floats, base: Floats, slope: Floats, bend: Floats, slopes: Floats, bends: Floats
) -> Floats:
    """Sum of squares left by 1, s, s^2, cos f and sin f for each slope and bend, shape (n_slopes, n_bends).

    Few fringes and a curved offset look alike: here both are fitted together.
    """
    left = np.empty((slopes.size, bends.size))
    matrix, vector, row = np.empty((5, 5)), np.empty(5), np.empty(5)
    total = 0.0
    for k in range(s.size):
        total += weight[k] * signal[k] * signal[k]
    for a in range(slopes.size):
        for b in range(bends.size):
            matrix[:] = 0.0
            vector[:] = 0.0
            for k in range(s.size):
                f = base[k] + slopes[a] * slope[k] + bends[b] * bend[k]
                row[0], row[1], row[2], row[3], row[4] = 1.0, s[k], s[k] * s[k], np.cos(f), np.sin(f)
                for i in range(5):
                    scaled = weight[k] * row[i]
                    vector[i] += scaled * signal[k]
                    for j in range(i + 1):
                        matrix[i, j] += scaled * row[j]
            # L D L' in place; a tiny ridge keeps a fringe that looks like a parabola solvable.
            explained = 0.0
            for i in range(5):
                pivot = matrix[i, i] * (1.0 + 1e-6) + 1e-12
                for j in range(i):
                    coupled = matrix[i, j]
                    for m in range(j):
                        coupled -= matrix[i, m] * matrix[j, m] * matrix[m, m]
                    matrix[i, j] = coupled / matrix[j, j]
                    pivot -= matrix[i, j] * coupled
                    vector[i] -= matrix[i, j] * vector[j]
                matrix[i, i] = pivot
                explained += vector[i] * vector[i] / pivot
            left[a, b] = total - explained
    return left
