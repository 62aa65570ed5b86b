"""Joint values that cancel what is known of the error motions along a path.

A path is driven so that the cavity length changes by what the geometry expects: the joint that travels along the beam
makes up for the posterior mean of the repeatable motions, reversal by the direction of approach included. This moves
the joint at every point, which turns its own direction of approach and brings a new return error each time: where that
costs more than it gains, the path stays as it is. So it does where the mean is small beside the stated sizes, as on a
machine that is better than its sheet: it is then what noise left.
"""

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.mechanics.design import PathDesign, path_design
from fpcal_bayes.model.mechanics.terms import Terms

#: A joint that moves the cavity length by less than this share of its own travel does not make up for anything.
_LEAST_SLOPE = 0.5
#: A mean that spreads by less than this share of what the sheet lets expect is not made up for.
_WORTH = 0.2
#: The directions of approach follow from the path that they change.
_ROUNDS = 3
#: A round that moves no point by more than this changes nothing, in um.
_SAME_UM = 1e-10


def compensated_path(
    terms: Terms,
    vector: Floats,
    weights: Floats,
    start: Floats,
    q: Floats,
    *,
    before: Floats | None = None,
    geometry: Floats | float = 0.0,
    return_factor: float = 1.0,
) -> tuple[Floats, Floats]:
    """A path that makes up for the mean of the error motions, or the path itself where that gains nothing.

    It is driven from `start` (n_joints,) along `q` (n_points, n_joints), the joints standing at `before` until then.
    weights: posterior mean in units of their stated sizes, shape (n_weights,); `return_factor` is on return errors.
    geometry: what the geometry is expected to add beyond `vector`, shape (n_points,), in um.
    Returns the joint path, and what it adds to the change of length that the geometry expects of `q`, (n_points,).
    """
    cell, as_it_is = terms.cell, (q, np.zeros(len(q)))
    if not len(q):
        return as_it_is
    first = np.zeros((0, len(start))) if before is None else before[None]
    made = path_design(terms, vector, start, np.vstack([first, q]))
    drive = made.drive[1 + len(first) :]
    slopes = np.where(cell.revolute, 0.0, np.abs(drive).min(axis=0, initial=np.inf))
    joint = int(np.argmax(slopes))
    if slopes[joint] < _LEAST_SLOPE:
        return as_it_is

    def driven(made: PathDesign) -> tuple[Floats, float, Floats]:
        motions, moving = made.motions[len(first) :], np.ptp(made.steps, axis=0) > 0
        # What is new each time: return errors of the joints that move.
        returned = float((made.returned_point[:, moving] ** 2).sum(axis=1).mean())
        return geometry + motions @ weights, return_factor**2 * returned, motions

    plain, new, motions = driven(made)
    if _spread(plain) < _WORTH**2 * _spread(motions).sum():
        return as_it_is
    moved, error, again = q.copy(), plain, new
    for _ in range(_ROUNDS):
        wanted = np.clip(q[:, joint] - error / drive[:, joint], cell.low[joint], cell.high[joint])
        if np.abs(wanted - moved[:, joint]).max() < _SAME_UM:
            break
        moved[:, joint] = wanted
        error, again, _ = driven(path_design(terms, vector, start, np.vstack([first, moved])))
    added = (moved - q)[:, joint] * drive[:, joint]
    return (moved, added) if _spread(error + added) + again < _spread(plain) + new else as_it_is


def _spread(errors: Floats) -> Floats:
    """Variance along a path (n_points, ...); of one point alone its square, in um^2."""
    return np.asarray(np.var(errors, axis=0) if len(errors) > 1 else errors[0] ** 2)
