"""The search: candidates are taken one by one, then exchanged for better ones (Fedorov 1972) until none is left."""

import numpy as np

from fpcal_bayes.infer.planning.criteria import Criterion

#: An exchange must make the criterion smaller by this share.
_LEAST_GAIN = 1e-4


def greedy(criterion: Criterion, n: int, chosen: tuple[int, ...] = ()) -> tuple[int, ...]:
    """Add candidates to those chosen, each time the best one, until there are `n`."""
    found = list(chosen)
    while len(found) < n:
        values = criterion.if_added(found, None)
        values[found] = np.inf
        found.append(int(np.argmin(values)))
    return tuple(found)


def exchange(criterion: Criterion, chosen: tuple[int, ...], *, passes: int = 5, fixed: int = 0) -> tuple[int, ...]:
    """Exchange chosen candidates one at a time for the best that takes their place, until nothing is gained.

    Parameters
    ----------
    passes
        How often each candidate is looked at, at most.
    fixed
        The first so many stay.
    """
    found, best, unchanged = list(chosen), criterion.value(chosen), 0
    places = list(range(fixed, len(found)))
    for place in places * passes:
        others = found[:place] + found[place + 1 :]
        values = criterion.if_added(others, None)
        values[others] = np.inf
        winner = int(np.argmin(values))
        unchanged += 1
        if winner != found[place] and values[winner] < best - _LEAST_GAIN * abs(best):
            found[place], best, unchanged = winner, float(values[winner]), 0
        if unchanged >= len(places):
            break
    return tuple(found)


def most_useful_first(criterion: Criterion, chosen: tuple[int, ...]) -> tuple[int, ...]:
    """The chosen candidates in the order in which a greedy search among them alone takes them."""
    found: list[int] = []
    while len(found) < len(chosen):
        rest = [index for index in chosen if index not in found]
        values = criterion.if_added(found, np.array(rest, dtype=np.int64))
        found.append(rest[int(np.argmin(values))])
    return tuple(found)
