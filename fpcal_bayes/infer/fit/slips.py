"""Sweeps whose fringe count slipped: dL off by whole half wavelengths.

Slips are looked for one at a time: of all corrections by k half wavelengths, the one that lowers the refitted sum of
squares most is made, as long as it lowers it by more than chance and the rarity of slips allow. A correction is that of
one row, or of a row with those after it in its group: a count that slips on the way is off from there on. What is
bounded is the slip from one row of a group to the next.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.fit.minimise import Solution, minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.measure.sharing import Sharing

#: Most half wavelengths that a count slips by between two readings.
MOST_HALF_WAVES = 3
#: A correction must lower the sum of squares by more than this: odds of e^10 against a slip, before the data.
_LEAST_GAIN = 20.0


@dataclass(frozen=True)
class Slips:
    """Corrections found."""

    counts: Ints  # half wavelengths to take from each dL, shape (n_rows,)
    problem: Problem  # with the corrected values
    solution: Solution  # its minimum


def find_slips(problem: Problem, solution: Solution) -> Slips:
    """Correct slipped rows of an identified problem, whose solution slips may have spoilt."""
    half_wave = problem.model.half_waves(problem.rows)
    original = problem.target
    counts = np.zeros(len(original), dtype=np.int64)
    blocks = Sharing.of(problem.sweeps).read_alike
    together = [np.array([i]) for i in range(len(original))]
    together += [block[i:] for block in blocks for i in range(len(block) - 1)]
    # Of each row the one before and the one after it in its group; a row that is not there has the count zero.
    before, after = np.full((2, len(original)), -1)
    for block in blocks:
        before[block[1:]], after[block[:-1]] = block[:-1], block[1:]
    first, last = np.array([(rows[0], rows[-1]) for rows in together]).T
    ends = np.array([before[first], first, last, after[last]])
    for _ in range(len(original)):
        rows, step, gain = _best_correction(problem, solution, counts, half_wave, together, ends)
        if gain < _LEAST_GAIN:
            break
        trial = counts.copy()
        trial[rows] += step
        corrected = problem.with_target(original - half_wave * trial)
        # A fit that slips spoilt may have ended far off: the prior mean is tried as well.
        found = [minimise(corrected, start) for start in (solution.unknowns, np.zeros(problem.n_unknowns))]
        better = min(found, key=lambda s: (not s.converged, s.sum_of_squares))
        if better.sum_of_squares > solution.sum_of_squares - 1.0:
            break
        problem, solution, counts = corrected, better, trial
    return Slips(counts, problem, solution)


def _best_correction(
    problem: Problem, solution: Solution, counts: Ints, half_wave: Floats, together: list[Ints], ends: Ints
) -> tuple[Ints, int, float]:
    """Rows, change of their counts, and gain in the sum of squares of the best correction; the fit follows linearly."""
    unknowns = solution.unknowns
    residuals = problem.data_residuals(unknowns)
    orthonormal = linalg.qr(problem.jacobian(unknowns), mode="economic")[0][: len(residuals)]
    rows, first = np.concatenate(together), np.cumsum([0, *map(len, together)])
    chosen = sparse.csc_array((half_wave[rows], rows, first), shape=(len(counts), len(together)))
    unit = sparse.csc_array(problem.whitening.as_matrix @ chosen)
    along = unit.T @ residuals
    size = unit.multiply(unit).sum(axis=0) - ((unit.T @ orthonormal) ** 2).sum(axis=1)
    before, begun, ended, after = np.append(counts, 0)[ends]
    # Nothing slips behind the last row.
    slips = np.array([begun - before, np.where(ends[3] < 0, 0, after - ended)])
    best = (together[0], 0, -np.inf)
    for step in range(-2 * MOST_HALF_WAVES, 2 * MOST_HALF_WAVES + 1):
        if step == 0:
            continue
        # Taking one more half wavelength from dL raises prediction minus measurement by it.
        gain = -(2.0 * step * along + step**2 * size)
        # A slip more is a priori rarer than one less.
        then = slips + step * np.array([np.ones_like(ends[3]), np.where(ends[3] < 0, 0, -1)])
        gain += 0.5 * _LEAST_GAIN * ((slips != 0).sum(axis=0) - (then != 0).sum(axis=0)).astype(float)
        gain[(np.abs(then) > MOST_HALF_WAVES).any(axis=0)] = -np.inf
        column = int(np.argmax(gain))
        if gain[column] > best[2]:
            best = (together[column], step, float(gain[column]))
    return best
