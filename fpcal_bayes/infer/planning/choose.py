"""Choose sweeps among candidates: the one entry for planning and for deciding what to measure next."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.planning.criteria import criterion_by_name
from fpcal_bayes.infer.planning.design import Design
from fpcal_bayes.infer.planning.exchange import exchange, greedy, most_useful_first
from fpcal_bayes.measure.sweeps import Sweeps

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ChosenSweeps:
    """Sweeps chosen among candidates.

    Attributes
    ----------
    indices
        Positions among the candidates, the most useful first.
    sweeps
        The chosen candidates in this order, as a plan of whole sweeps.
    sd
        Expected worst-point standard deviation of each task in um: before any of them, after the first, and so on,
        shape (len(indices) + 1,); the root of the mean variance over the draws.
    """

    indices: tuple[int, ...]
    sweeps: Sweeps
    sd: dict[str, Floats]

    def __len__(self) -> int:
        return len(self.indices)


def choose_sweeps(
    candidates: Sweeps,
    rows: Floats,
    tasks: Mapping[str, Floats],
    n: int,
    *,
    covariance: Floats | None = None,
    known: Floats | None = None,
    tolerances: Mapping[str, float] | None = None,
    criterion: str = "worst",
    passes: int = 5,
) -> ChosenSweeps:
    """Choose sweeps that leave least unknown of the tasks.

    Parameters
    ----------
    candidates
        Whole sweeps, as from `candidate_sweeps`.
    rows
        Their whitened rows by the state, as from `sweep_rows`, at one point or over draws: shape (n_draws,
        n_candidates, readings, n).
    tasks
        Derivatives of each task's points by the state in um, shape (n_draws or 1, n_points, n).
    n
        How many to choose.
    covariance
        Of the state as it is known now, in the units that the derivatives are by, shape (n, n); by default the
        identity.
    known
        Whitened rows of what is measured in any case, shape (n_draws, n_rows, n).
    tolerances
        Standard deviation that each task is judged by, in um; by default all alike.
    criterion
        One of `CRITERIA`.
    passes
        Passes of the exchange; 0 takes sweeps greedily.

    Returns
    -------
    ChosenSweeps
        The same for the same arguments: nothing is drawn.

    Raises
    ------
    InputError
        If there are fewer candidates than sweeps wanted, no task, or a criterion or tolerance that is unknown.
    """
    if not 1 <= n <= len(candidates):
        raise InputError(f"{n} sweeps out of {len(candidates)} candidates: expected 1 to {len(candidates)}")
    reference = reference_of(tuple(tasks), tolerances)
    design = Design.of(rows, tasks, covariance, known)
    judge = criterion_by_name(criterion, design, reference)
    chosen = greedy(judge, n)
    if passes:
        chosen = most_useful_first(judge, exchange(judge, chosen, passes=passes))
    return chosen_sweeps(design, candidates, chosen)


def chosen_sweeps(design: Design, candidates: Sweeps, chosen: tuple[int, ...]) -> ChosenSweeps:
    """The chosen candidates with what each of them leaves."""
    variances = np.array([design.expected_variance(chosen[:count]) for count in range(len(chosen) + 1)])
    sd = dict(zip(design.names, np.sqrt(variances).T, strict=True))
    return ChosenSweeps(chosen, candidates.take(np.array(chosen, dtype=np.int64)), sd)


def reference_of(names: tuple[str, ...], tolerances: Mapping[str, float] | None) -> Floats:
    """Standard deviation that each task is judged by, in um, shape (n_tasks,); `InputError` if one is unknown."""
    if not names:
        raise InputError("no task to plan for: expected one at least")
    if tolerances is None:
        return np.ones(len(names))
    for name in tolerances:
        if name not in names:
            raise InputError(f"tolerance of an unknown task {name!r}: expected one of {', '.join(names)}")
    reference = np.array([tolerances.get(name, np.inf) for name in names])
    if not (reference > 0).all() or not np.isfinite(reference).any():
        raise InputError("tolerances of tasks: expected numbers above zero")
    return reference
