"""Sweeps whose fringe count slipped: dL off by whole half wavelengths.

Slips are looked for one at a time: of all corrections by k half wavelengths, the one that lowers the refitted sum of
squares most is made, as long as it lowers it by more than chance and the rarity of slips allow. A correction is that of
one row, or of a row with those after it in its group: a count that slips on the way is off from there on.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from fpcal_bayes.core.typing import Ints
from fpcal_bayes.infer.fit.minimise import Solution, minimise
from fpcal_bayes.infer.fit.noise import group_blocks
from fpcal_bayes.infer.fit.problem import Problem

#: Most half wavelengths that a count is off by.
MOST_HALF_WAVES = 3
#: A correction must lower the sum of squares by more than this: odds of e^10 against a slip, before the data.
_LEAST_GAIN = 20.0


@dataclass(frozen=True)
class Slips:
    """Corrections found."""

    counts: Ints  # half wavelengths to take from each dL, shape (n_rows,)
    # problem, solution: with the corrected values, and its minimum
    problem: Problem
    solution: Solution


def find_slips(problem: Problem, solution: Solution) -> Slips:
    """Correct slipped rows of an identified problem, whose solution slips may have spoilt."""
    half_wave = 0.5 * problem.model.cell.wavelength
    original = problem.target
    counts = np.zeros(len(original), dtype=np.int64)
    together = [np.array([i]) for i in range(len(original))]
    together += [block[i:] for block in group_blocks(problem.sweeps) for i in range(len(block) - 1)]
    for _ in range(len(original)):
        rows, step, gain = _best_correction(problem, solution, counts, half_wave, together)
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
    problem: Problem, solution: Solution, counts: Ints, half_wave: float, together: list[Ints]
) -> tuple[Ints, int, float]:
    """Rows, change of their counts, and gain in the sum of squares of the best correction; the fit follows linearly."""
    unknowns = solution.unknowns
    residuals = problem.data_residuals(unknowns)
    orthonormal = linalg.qr(problem.jacobian(unknowns), mode="economic")[0][: len(residuals)]
    mix = problem.whitening.mix
    whitening = sparse.diags_array(problem.whitening.scale) if mix is None else mix
    rows, first = np.concatenate(together), np.cumsum([0, *map(len, together)])
    chosen = sparse.csc_array((np.full(len(rows), half_wave), rows, first), shape=(len(counts), len(together)))
    unit = sparse.csc_array(whitening @ chosen)
    along = unit.T @ residuals
    size = unit.multiply(unit).sum(axis=0) - ((unit.T @ orthonormal) ** 2).sum(axis=1)
    low = np.minimum.reduceat(counts[rows], first[:-1])
    high = np.maximum.reduceat(counts[rows], first[:-1])
    best = (together[0], 0, -np.inf)
    for step in range(-2 * MOST_HALF_WAVES, 2 * MOST_HALF_WAVES + 1):
        if step == 0:
            continue
        # Taking one more half wavelength from dL raises prediction minus measurement by it.
        gain = -(2.0 * step * along + step**2 * size)
        # A slip more is a priori rarer than one less.
        slipped_now = (low != 0) | (high != 0)
        slipped_then = (low + step != 0) | (high + step != 0)
        gain += 0.5 * _LEAST_GAIN * (slipped_now.astype(float) - slipped_then)
        gain[(low + step < -MOST_HALF_WAVES) | (high + step > MOST_HALF_WAVES)] = -np.inf
        column = int(np.argmax(gain))
        if gain[column] > best[2]:
            best = (together[column], step, float(gain[column]))
    return best
