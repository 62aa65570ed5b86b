"""The order of a plan's sweeps, and how long it takes."""

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.candidates import SweepLimits
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.joint_path import travel_seconds


def in_short_order(cell: Cell, sweeps: Sweeps) -> Sweeps:
    """Sweeps in a short order: the nearest end each time from zero, then parts turned round (2-opt, Croes 1958)."""
    ends = np.stack([sweeps.q_start, sweeps.q_end])
    order, turned = _nearest(cell, ends)
    while True:
        first, last = ends[turned, order], ends[1 - turned, order]
        before = np.vstack([np.zeros((1, ends.shape[2])), last[:-1]])
        # Turning round sweeps i to j replaces the way into i and the way out of j; nothing follows the last.
        into = travel_seconds(cell, first - before)
        out = np.append(into[1:], 0.0)
        to_last = travel_seconds(cell, last[None, :] - before[:, None])
        from_first = travel_seconds(cell, first[:, None] - np.vstack([first[1:], first[:1]])[None, :])
        from_first[:, -1] = 0.0
        change = np.where(np.tri(len(order), dtype=bool).T, to_last + from_first - into[:, None] - out[None, :], 0.0)
        i, j = (int(k) for k in np.unravel_index(np.argmin(change), change.shape))
        if change[i, j] > -1e-9:
            break
        order[i : j + 1], turned[i : j + 1] = order[i : j + 1][::-1].copy(), 1 - turned[i : j + 1][::-1]
    labels = sweeps.label[order].tolist()
    return Sweeps.of_um_rad(ends[turned, order], ends[1 - turned, order], label=labels, file=sweeps.file)


def duration(cell: Cell, sweeps: Sweeps, readings: int, limits: SweepLimits) -> float:
    """Seconds from joint vector zero through all sweeps in their order: ways, sweeps, and settling at each reading."""
    before = np.vstack([np.zeros((1, len(cell.joints))), sweeps.q_end[:-1]])
    moving = travel_seconds(cell, sweeps.q_start - before) + travel_seconds(cell, sweeps.q_end - sweeps.q_start)
    return float(moving.sum() + limits.settling * (1 + max(readings, 1)) * len(sweeps))


def _nearest(cell: Cell, ends: Floats) -> tuple[Ints, Ints]:
    """Sweeps taken from the nearest end each time: their order, and whether each is turned round."""
    n = ends.shape[1]
    order, turned, left = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.ones(n, dtype=bool)
    here = np.zeros(ends.shape[2])
    for step in range(n):
        ways = np.where(left, travel_seconds(cell, ends - here), np.inf)
        side, sweep = (int(k) for k in np.unravel_index(np.argmin(ways), ways.shape))
        order[step], turned[step], left[sweep] = sweep, side, False
        here = ends[1 - side, sweep]
    return order, turned
