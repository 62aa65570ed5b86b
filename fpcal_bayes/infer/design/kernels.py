"""Compiled kernels: what each candidate sweep would leave unknown, and what chosen ones leave.

With the rows W (k, n) of a candidate in units of the present uncertainty, the covariance shrinks to I - W' S^-1 W,
S = I + W W' (Woodbury), so that a task whose derivatives are V in these units keeps the variance v'v - |L^-1 W v|^2,
S = L L'. Only k x k systems are solved.
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled


@compiled
def add_left(
    noise: Floats, rows: Floats, sign: float, products: Floats, left_of: Floats, starts: Ints, worst: bool, left: Floats
) -> None:
    """Add up, over the draws, the task variances that each candidate would leave, in `left` (n_candidates, n_tasks).

    noise, rows, sign: of each candidate S = noise + sign rows rows', shapes (n_candidates, k, k) and (.., k, n).
    products: W V', shape (n_candidates, k, n_points); overwritten. left_of: variances now, shape (n_points,).
    starts: where the points of each task start, and where the last ends, shape (n_tasks + 1,).
    worst: take the worst point of a task, else the mean over its points.
    """
    n_candidates, k, n = rows.shape
    n_points = left_of.size
    factor, value = np.empty((k, k)), np.empty(n_points)
    for c in range(n_candidates):
        value[:] = left_of
        for i in range(k):
            for j in range(i + 1):
                total = 0.0
                for m in range(n):
                    total += rows[c, i, m] * rows[c, j, m]
                total = noise[c, i, j] + sign * total
                for m in range(j):
                    total -= factor[i, m] * factor[j, m]
                factor[i, j] = math.sqrt(total) if i == j else total / factor[j, j]
            for j in range(i):
                share = factor[i, j]
                for p in range(n_points):
                    products[c, i, p] -= share * products[c, j, p]
            scale = 1.0 / factor[i, i]
            for p in range(n_points):
                products[c, i, p] *= scale
                value[p] -= products[c, i, p] * products[c, i, p]
        for task in range(starts.size - 1):
            first, last = starts[task], starts[task + 1]
            total = 0.0
            for p in range(first, last):
                total = max(total, value[p]) if worst else total + value[p]
            left[c, task] += total if worst else total / (last - first)


@compiled
def worst_points(base: Floats, rows: Floats, tasks: Floats, starts: Ints, variance: Floats, directions: Floats) -> None:
    """Worst point of each task at each draw after rows, by the Cholesky factor of the information.

    base, rows, tasks: the information before the rows (n_draws, n, n), shapes (.., n_rows, n) and (.., n_points, n).
    starts: as of `add_left`.
    variance, directions: written, the worst point's (n_draws, n_tasks), and covariance times its derivatives (.., n).
    """
    n_draws, n_rows, n = rows.shape
    n_points = tasks.shape[1]
    upper, seen, total = np.empty((n, n)), np.empty((n, n_points)), np.empty(n_points)
    for d in range(n_draws):
        upper[:] = base[d]
        for r in range(n_rows):
            row = rows[d, r]
            for i in range(n):
                for j in range(i, n):
                    upper[i, j] += row[i] * row[j]
        for p in range(n_points):
            total[p] = 0.0
            for i in range(n):
                seen[i, p] = tasks[d, p, i]
        for k in range(n):
            scale = 1.0 / math.sqrt(upper[k, k])
            for j in range(k, n):
                upper[k, j] *= scale
            for p in range(n_points):
                seen[k, p] *= scale
                total[p] += seen[k, p] * seen[k, p]
            for i in range(k + 1, n):
                share = upper[k, i]
                for j in range(i, n):
                    upper[i, j] -= share * upper[k, j]
                for p in range(n_points):
                    seen[i, p] -= share * seen[k, p]
        for task in range(starts.size - 1):
            worst = starts[task]
            for p in range(starts[task], starts[task + 1]):
                if total[p] > total[worst]:
                    worst = p
            variance[d, task] = total[worst]
            for k in range(n - 1, -1, -1):
                value = seen[k, worst]
                for j in range(k + 1, n):
                    value -= upper[k, j] * directions[d, task, j]
                directions[d, task, k] = value / upper[k, k]
