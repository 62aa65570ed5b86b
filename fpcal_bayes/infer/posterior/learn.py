"""Choose the charts by a trial before the sampling: where the proposals are too rare, a further chart helps.

A chart proposes less and less towards its fold, where its determinant goes to zero, and an independent move then stays
too long at the points that it finds there. A chart whose reference point is such a point has its fold elsewhere.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fpcal_bayes.infer.posterior.atlas import Atlas
from fpcal_bayes.infer.posterior.target import Target

Floats = NDArray[np.float64]

#: A point that deserves more than this many times the proposals it gets is too rare.
_MOST_WEIGHT = 8.0
_TRIALS = 2048
_MOST_CHARTS = 4


def learn_charts(target: Target, minima: Floats, rng: np.random.Generator) -> Floats:
    """Reference points of the charts.

    Parameters
    ----------
    minima
        Minima of the sum of squares, shape (n_minima, n).
    rng
        Of the trials.

    Returns
    -------
    ndarray
        The minima and further points, shape (n_charts, n).
    """
    references = minima
    while len(references) < max(_MOST_CHARTS, len(minima) + 1):
        atlas = Atlas(target, references)
        solved = atlas.propose(rng.standard_normal((_TRIALS, target.n_unknowns)), rng.random(_TRIALS))
        log_weights = np.full(_TRIALS, -np.inf)
        found = solved.inside
        log_weights[found] = solved.log_density[found] - solved.log_proposal[found]
        log_mean = special.logsumexp(log_weights) - np.log(_TRIALS)
        heaviest = int(np.argmax(log_weights))
        if log_weights[heaviest] < log_mean + np.log(_MOST_WEIGHT):
            break
        references = np.vstack([references, solved.points[heaviest]])
    return references
