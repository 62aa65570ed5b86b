"""Compiled kernel: the sum over all ways in which the fringe counts of a group of rows may have slipped.

A count that slips between two readings of a group is off from there on, and an error of one row moves, through the
whitening, the rows after it. The sum over the slips of all rows of a group runs depth first, each row's likeliest slip
first; branches that cannot add anything to a number in double precision are left out.
"""

import math
from typing import Any

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled

#: A branch this much below the best so far (natural logarithm) adds less than rounding does.
_NEGLIGIBLE = 60.0


@compiled
def slip_sums(
    residuals: Floats,
    log_odds: Floats,
    corrected: Ints,
    can_slip: Bools,
    steps: tuple[float, int],
    group: Any,
    prefix: int,
) -> tuple[Floats, Floats]:
    """Log density of each group's first rows, (n_points, n_groups), and whether each count is right, as probability.

    The density is without the constant of the normal one; the probabilities, (n_points, n_rows), are of the members.

    residuals: whitened rows of the corrected problem, shape (n_points, n_rows).
    log_odds: logarithms of the probabilities of one particular slip and of none, shape (2, n_points).
    corrected, can_slip: half wavelengths taken from each row already, and whether it may slip, shape (n_rows,).
    steps: half a wavelength in um, and the most that a count slips by from one row of a group to the next.
    group: the whitening of the groups, as for `whiten_groups`.
    prefix: how many rows of each group count; the others are as if not measured.
    """
    half_wave, most = steps
    log_eps, log_not = log_odds
    members, own, shared, gain, scale = group
    n_groups, _, n_common = shared.shape
    n_counts = 2 * most + 1
    total, stayed = np.empty((residuals.shape[0], n_groups)), np.ones(residuals.shape)
    # State before each row: effect of the slips of earlier rows, count, log density so far, and which slip is next.
    told = np.zeros((prefix + 1, n_common))
    level = np.zeros(prefix + 1, dtype=np.int64)
    so_far = np.zeros(prefix + 1)
    tried = np.zeros((prefix, n_counts), dtype=np.bool_)
    terms = np.empty((prefix, n_counts))
    kept = np.empty(prefix)
    for p in range(residuals.shape[0]):
        for g in range(n_groups):
            best, sum_all = -np.inf, 0.0
            kept[:] = 0.0
            depth = 0
            fresh = True
            while depth >= 0:
                row = members[g, depth]
                if fresh:
                    # Log density of this row for each count, given the counts of the rows before it.
                    before = 0.0
                    for c in range(n_common):
                        before += gain[g, depth, c] * told[depth, c]
                    for k in range(n_counts):
                        count = k - most
                        tried[depth, k] = False
                        if count != 0 and not can_slip[row]:
                            terms[depth, k] = -np.inf
                            continue
                        moved = (level[depth] + count - corrected[row]) * half_wave * own[g, depth]
                        value = residuals[p, row] + (moved - before) * scale[g, depth]
                        weight = (log_eps[p] if count else log_not[p]) if can_slip[row] else 0.0
                        terms[depth, k] = weight - 0.5 * value * value
                # The likeliest count that is left.
                chosen = -1
                for k in range(n_counts):
                    if not tried[depth, k] and (chosen < 0 or terms[depth, k] > terms[depth, chosen]):
                        chosen = k
                if chosen < 0 or not so_far[depth] + terms[depth, chosen] > best - _NEGLIGIBLE:
                    depth -= 1
                    fresh = False
                    continue
                tried[depth, chosen] = True
                level[depth + 1] = level[depth] + chosen - most
                reached = so_far[depth] + terms[depth, chosen]
                if depth + 1 < prefix:
                    moved = (level[depth + 1] - corrected[row]) * half_wave * own[g, depth]
                    for c in range(n_common):
                        told[depth + 1, c] = told[depth, c] + shared[g, depth, c] * moved
                    so_far[depth + 1] = reached
                    depth += 1
                    fresh = True
                    continue
                fresh = False
                if reached > best:
                    shrink = math.exp(best - reached)
                    sum_all *= shrink
                    for m in range(prefix):
                        kept[m] *= shrink
                    best = reached
                weight = math.exp(reached - best)
                sum_all += weight
                for m in range(prefix):
                    if level[m + 1] == 0:
                        kept[m] += weight
            total[p, g] = best + math.log(sum_all)
            for m in range(prefix):
                stayed[p, members[g, m]] = kept[m] / sum_all
    return total, stayed
