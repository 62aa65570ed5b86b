"""Refinement: chosen sweeps are varied one at a time, and replaced by the variation that serves best."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.infer.planning.criteria import Criterion
from fpcal_bayes.measure.sweeps import Sweeps, join

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Widths of the variations as shares of the joints' ranges, from coarse to fine.
WIDTHS = (0.5, 0.4, 0.3, 0.3, 0.2, 0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.1, 0.07, 0.07, 0.05, 0.05, 0.03, 0.03, 0.02, 0.02)


def refine(
    chosen: Sweeps,
    vary: Callable[[Sweeps, float], tuple[Sweeps, Ints]],
    judge: Callable[[Sweeps], Criterion],
    *,
    widths: tuple[float, ...] = WIDTHS,
) -> Sweeps:
    """Vary chosen sweeps and keep what makes the criterion smaller.

    Parameters
    ----------
    chosen
        The sweeps so far, a plan.
    vary
        Variations of a width, and which sweep each of them may replace.
    judge
        The criterion over a set of candidates.
    widths
        One round a width.
    """
    n = len(chosen)
    for width in widths:
        variations, replaced = vary(chosen, width)
        criterion = judge(join([chosen, variations], "candidates"))
        found = list(range(n))
        for place in range(n):
            among = np.concatenate([[found[place]], n + np.flatnonzero(replaced == place)])
            values = criterion.if_added(found[:place] + found[place + 1 :], among)
            found[place] = int(among[np.argmin(values)])
        chosen = join([chosen, variations], "candidates").take(np.array(found))
    return chosen
