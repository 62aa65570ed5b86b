"""Compiled kernel: whiten rows that share a reading."""

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.model.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@compiled
def whiten_groups(rows: Floats, members: Ints, own: Floats, shared: Floats, gain: Floats, scale: Floats) -> None:
    """Take off each row, in place, what those before it in its group tell about their common errors.

    Parameters
    ----------
    rows
        Shape (n_points, n_rows, n), contiguous; the members are overwritten.
    members
        Positions of the rows of each group, shape (n_groups, n_members).
    own
        One over the standard deviation of each row's own error, same shape.
    shared, gain
        Effect of the common errors on each row, and their estimate from it, shape (n_groups, n_members, n_common).
    scale
        One over the standard deviation of what is left, shape (n_groups, n_members).
    """
    n_groups, n_members, n_common = shared.shape
    n = rows.shape[2]
    told = np.empty((n_common, n))
    for p in range(rows.shape[0]):
        for g in range(n_groups):
            told[:] = 0.0
            for m in range(n_members):
                row = members[g, m]
                for j in range(n):
                    value = rows[p, row, j] * own[g, m]
                    predicted = 0.0
                    for c in range(n_common):
                        predicted += gain[g, m, c] * told[c, j]
                        told[c, j] += shared[g, m, c] * value
                    rows[p, row, j] = (value - predicted) * scale[g, m]
