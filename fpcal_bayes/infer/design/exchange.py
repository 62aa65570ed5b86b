"""Choose sweeps: greedily among candidates, and by exchange."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.information import Criterion, Design
from fpcal_bayes.measure.sweeps import Sweeps

#: An exchange must make the criterion smaller by this share.
_LEAST_GAIN = 1e-4


def greedy(criterion: Criterion, n: int, chosen: tuple[int, ...] = ()) -> tuple[int, ...]:
    """Add candidates to those chosen, each time the best one, until there are `n`."""
    found = list(chosen)
    while len(found) < n:
        values = criterion.if_added(found)
        values[found] = np.inf
        found.append(int(np.argmin(values)))
    return tuple(found)


def exchange(criterion: Criterion, chosen: tuple[int, ...], *, passes: int = 5) -> tuple[int, ...]:
    """Exchange chosen candidates one at a time for the best in their place, until nothing is gained in `passes`."""
    found, best, unchanged = list(chosen), criterion.value(chosen), 0
    places = list(range(len(found)))
    for place in places * passes:
        others = found[:place] + found[place + 1 :]
        values = criterion.if_added(others)
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
        values, rest = criterion.if_added(found), [index for index in chosen if index not in found]
        found.append(rest[int(np.argmin(values[rest]))])
    return tuple(found)


@dataclass(frozen=True)
class ChosenSweeps:
    """Sweeps chosen among candidates."""

    indices: tuple[int, ...]  # positions among the candidates, the most useful first
    sweeps: Sweeps  # the chosen candidates in this order, as a plan of whole sweeps
    # expected worst-point standard deviation of each task in um: before any of them, after the first, and so on, shape
    # (len(indices) + 1,); the root of the mean variance over the draws
    sd: dict[str, Floats]

    def __len__(self) -> int:
        return len(self.indices)

    def first(self, n: int) -> "ChosenSweeps":
        """The `n` most useful of them."""
        sd = {task: sd[: n + 1] for task, sd in self.sd.items()}
        return ChosenSweeps(self.indices[:n], self.sweeps.take(np.arange(n)), sd)


def choose_sweeps(
    rows: Floats, tasks: Mapping[str, Floats], n: int, covariance: Floats, *, mean: bool = False, passes: int = 5
) -> tuple[int, ...]:
    """Positions of the `n` candidates that leave least unknown of the tasks, the most useful first.

    `rows` are whitened, by the state, shape (n_draws, n_candidates, readings, n_state), as from `sweep_rows`; `tasks`
    the derivatives of each task's points in um, shape (n_draws or 1, n_points, n_state), and `covariance` (n_state,
    n_state) that of the state as it is known now. The worst task's worst point counts, or with `mean` all alike.
    Without `passes` of the exchange candidates are taken greedily. `InputError` if there are fewer than `n`.
    """
    require_possible(n, rows.shape[1])
    judge = Criterion(Design.of(rows, tasks, covariance), np.ones(len(tasks)), mean)
    chosen = greedy(judge, n)
    return most_useful_first(judge, exchange(judge, chosen, passes=passes)) if passes else chosen


def require_possible(n: int, count: int) -> None:
    """`InputError` if `n` sweeps cannot be chosen among so many."""
    if not 1 <= n <= count:
        raise InputError(f"{n} sweeps out of {count} candidates: expected 1 to {count}")


def chosen_sweeps(design: Design, candidates: Sweeps, chosen: tuple[int, ...]) -> ChosenSweeps:
    """The chosen candidates with what each of them leaves."""
    variances = np.array([design.expected_variance(chosen[:count]) for count in range(len(chosen) + 1)])
    sd = dict(zip(design.names, np.sqrt(variances).T, strict=True))
    return ChosenSweeps(chosen, candidates.take(np.array(chosen, dtype=np.int64)), sd)


def reference_of(names: tuple[str, ...], tolerances: Mapping[str, float] | None) -> Floats:
    """Standard deviation that each task is judged by, in um, shape (n_tasks,); `InputError` if one is unknown."""
    if tolerances is None:
        return np.ones(len(names))
    for name in tolerances:
        if name not in names:
            raise InputError(f"tolerance of an unknown task {name!r}: expected one of {', '.join(names)}")
    reference = np.array([tolerances.get(name, np.inf) for name in names])
    if not (reference > 0).all() or not np.isfinite(reference).any():
        raise InputError("tolerances of tasks: expected numbers above zero")
    return reference
