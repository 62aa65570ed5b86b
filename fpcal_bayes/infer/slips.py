"""Sweeps whose fringe count slipped: dL off by whole half wavelengths.

Slips are looked for one at a time: of all single corrections of a row by k half wavelengths, the one that lowers the
refitted sum of squares most is made, as long as it lowers it by more than chance and the rarity of slips allow.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from fpcal_bayes.infer.least_squares import Solution, minimise
from fpcal_bayes.infer.problem import Problem

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Most half wavelengths that a count is off by.
MOST_HALF_WAVES = 3
#: A correction must lower the sum of squares by more than this: odds of e^10 against a slip, before the data.
_LEAST_GAIN = 20.0


@dataclass(frozen=True)
class Slips:
    """Corrections found.

    Attributes
    ----------
    counts
        Half wavelengths to take from each dL, shape (n_rows,).
    problem, solution
        With the corrected values, and its minimum.
    """

    counts: Ints
    problem: Problem
    solution: Solution


def find_slips(problem: Problem, solution: Solution) -> Slips:
    """Correct slipped rows of a fitted problem.

    Parameters
    ----------
    problem, solution
        From an identification, which slips may have spoilt.
    """
    half_wave = 0.5 * problem.model.cell.wavelength
    original = problem.target
    counts = np.zeros(len(original), dtype=np.int64)
    for _ in range(len(original)):
        row, count, gain = _best_correction(problem, solution, counts, half_wave)
        if gain < _LEAST_GAIN:
            break
        trial = counts.copy()
        trial[row] = count
        corrected = problem.with_target(original - half_wave * trial)
        # A fit that slips spoilt may have ended far off: the prior mean is tried as well.
        found = [minimise(corrected, start) for start in (solution.unknowns, np.zeros(problem.n_unknowns))]
        better = min(found, key=lambda s: (not s.converged, s.sum_of_squares))
        if better.sum_of_squares > solution.sum_of_squares - 1.0:
            break
        problem, solution, counts = corrected, better, trial
    return Slips(counts, problem, solution)


def _best_correction(problem: Problem, solution: Solution, counts: Ints, half_wave: float) -> tuple[int, int, float]:
    """Row, new count and gain in the sum of squares of the best change of one count, the fit following linearly."""
    unknowns = solution.unknowns
    residuals = problem.data_residuals(unknowns)
    orthonormal = linalg.qr(problem.jacobian(unknowns), mode="economic")[0][: len(residuals)]
    mix = problem.whitening.mix
    unit = sparse.csc_array(sparse.diags_array(problem.whitening.scale) if mix is None else mix) * half_wave
    along = unit.T @ residuals
    size = unit.multiply(unit).sum(axis=0) - ((unit.T @ orthonormal) ** 2).sum(axis=1)
    best = (0, 0, -np.inf)
    for count in range(-MOST_HALF_WAVES, MOST_HALF_WAVES + 1):
        # Taking one more half wavelength from dL raises prediction minus measurement by it.
        step = count - counts
        gain = np.where(step == 0, -np.inf, -(2.0 * step * along + step**2 * size))
        # A slip more is a priori rarer than one less.
        gain = gain + _LEAST_GAIN * ((counts != 0).astype(float) - (1.0 if count else 0.0)) * 0.5
        row = int(np.argmax(gain))
        if gain[row] > best[2]:
            best = (row, count, float(gain[row]))
    return best
