"""What makes a plan good: criteria over the expected covariance, all to be made small."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.information import Design

#: Power of the sum over tasks that stands for the worst of them: smooth enough to be climbed down, close to the worst.
_POWER = 6.0
#: Weight that takes the prior out of the observability index O1, as a factor on its standard deviations.
_FLAT = 1e3
#: Draws that the E criterion is averaged over; it takes an eigenvalue decomposition a candidate.
_E_DRAWS = 4
#: Directions in which all candidates together tell less than this share of the most are gauges.
_SEEN = 1e-9


@dataclass(frozen=True)
class Criterion:
    """A figure of merit that is to be small."""

    name: str  # one of `CRITERIA`
    design: Design  # as the criterion wants it
    # value if each candidate, of all or among those at given positions, were added to those chosen, shape (n,)
    if_added: Callable[[Sequence[int], Ints | None], Floats]
    value: Callable[[Sequence[int]], float]  # value of those chosen
    # what makes that value: directions u, shape (n_draws, n_pulls, n), and weights w, shape (n_draws, n_pulls), such
    # that a change dW of the rows W of the chosen changes it by the sum of -2 w (W u)'(dW u) over draws and pulls
    pull: Callable[[Sequence[int]], tuple[Floats, Floats]]
    scale: float = 1.0  # of its rows, beside those that it was given

    def slope(self, chosen: Sequence[int]) -> Floats:
        """Derivative of the value by the rows of those chosen, shape (n_draws, len(chosen), k, n)."""
        rows, (directions, weights) = self.design.rows[:, list(chosen)], self.pull(chosen)
        flat = rows.reshape(len(rows), -1, rows.shape[-1])
        seen = (flat @ directions.transpose(0, 2, 1)) * weights[:, None]
        return (-2.0 * seen @ directions).reshape(rows.shape)


def worst_task(design: Design, reference: Floats) -> Criterion:
    """Expected worst-point variance of the worst task, each in units of `reference` (n_tasks,) squared, in um."""

    def power_mean(variances: Floats) -> Floats:
        ratio = variances / reference**2
        largest = ratio.max(axis=-1, keepdims=True)
        return (((ratio / largest) ** _POWER).sum(axis=-1, keepdims=True) ** (1.0 / _POWER) * largest)[..., 0]

    def pull(chosen: Sequence[int]) -> tuple[Floats, Floats]:
        # Of each task the worst point alone counts, at each draw another one.
        variance, directions = design.worst_points(chosen)
        expected = variance.mean(axis=0)
        share = (expected / reference**2 / power_mean(expected)) ** (_POWER - 1.0) / reference**2 / len(variance)
        return directions, np.broadcast_to(share, variance.shape)

    return Criterion(
        "worst",
        design,
        lambda chosen, among: power_mean(design.if_added(chosen, among)[0]),
        lambda chosen: float(power_mean(design.worst_points(chosen)[0].mean(axis=0))),
        pull,
    )


def mean_task(design: Design, reference: Floats) -> Criterion:
    """Expected variance averaged over points and tasks, in units of `reference` squared (I-optimal)."""

    def pull(chosen: Sequence[int]) -> tuple[Floats, Floats]:
        roots = design.roots(chosen)
        share = 1.0 / (np.bincount(design.task_of_point) * reference**2 * len(reference) * len(roots))
        weights = np.broadcast_to(share[design.task_of_point], design.tasks.shape[:2])
        return design.tasks @ roots @ roots.transpose(0, 2, 1), weights

    return Criterion(
        "I",
        design,
        lambda chosen, among: (design.if_added(chosen, among, worst=False)[0] / reference**2).mean(axis=1),
        lambda chosen: float((design.expected_variance(chosen, worst=False) / reference**2).mean()),
        pull,
    )


def mean_parameter(design: Design, _: Floats) -> Criterion:
    """Expected variance averaged over the parameters, in prior units (A-optimal)."""

    def pull(chosen: Sequence[int]) -> tuple[Floats, Floats]:
        roots = design.roots(chosen)
        return roots @ roots.transpose(0, 2, 1), np.full(roots.shape[:2], 1.0 / roots.shape[0] / roots.shape[1])

    return Criterion(
        "A",
        design,
        lambda chosen, among: design.if_added(chosen, among, worst=False, whole_state=True)[0][:, 0],
        lambda chosen: float((design.roots(chosen) ** 2).sum(axis=(1, 2)).mean() / design.n_parameters),
        pull,
    )


def volume(design: Design, _: Floats) -> Criterion:
    """Expected logarithm of the posterior's volume squared (D-optimal), in natural units."""

    def value(chosen: Sequence[int]) -> float:
        diagonal = np.diagonal(design.roots(chosen), axis1=1, axis2=2)
        return float(2.0 * np.log(np.abs(diagonal)).sum(axis=1).mean())

    def pull(chosen: Sequence[int]) -> tuple[Floats, Floats]:
        roots = design.roots(chosen)
        return roots.transpose(0, 2, 1), np.full(roots.shape[:2], 1.0 / len(roots))

    return Criterion("D", design, lambda chosen, among: value(chosen) - design.if_added(chosen, among)[1], value, pull)


def observability_index(design: Design, reference: Floats) -> Criterion:
    """Observability index O1 (Borm and Menq 1989), the geometric mean of the singular values, without the prior.

    With a nearly flat prior the volume counts every direction that is seen by its singular value, and the directions
    that no sweep sees stay at the prior's size whatever is chosen.
    """
    flat = replace(design, rows=design.rows * _FLAT, tasks=design.tasks * _FLAT, base=_widened(design.base))
    return replace(volume(flat, reference), name="O1", scale=_FLAT)


def worst_direction(design: Design, _: Floats) -> Criterion:
    """Expected largest variance over the directions of the parameters that the candidates see (E-optimal)."""
    draws = min(_E_DRAWS, len(design.rows))
    part = replace(design, rows=design.rows[:draws], tasks=design.tasks[:draws], base=design.base[:draws])
    n = part.n_parameters
    seen = []
    for rows in part.rows:
        _, values, directions = np.linalg.svd(np.linalg.qr(rows.reshape(-1, n), mode="r"))
        seen.append(directions[: len(values)][values > _SEEN * values[0]])

    def if_added(chosen: Sequence[int], among: Ints | None) -> Floats:
        ours_only = part.rows if among is None else part.rows[:, among]
        total = np.zeros(ours_only.shape[1])
        for rows, root, basis in zip(ours_only, part.roots(chosen), seen, strict=True):
            scaled, ours = rows @ root, basis @ root
            inner = np.eye(rows.shape[1]) + scaled @ scaled.transpose(0, 2, 1)
            spread = scaled @ ours.T
            left = ours @ ours.T - spread.transpose(0, 2, 1) @ np.linalg.solve(inner, spread)
            total += np.linalg.eigvalsh(left)[:, -1]
        return total / draws

    def value(chosen: Sequence[int]) -> float:
        roots = part.roots(chosen)
        return float(np.mean([np.linalg.norm(basis @ root, 2) ** 2 for basis, root in zip(seen, roots, strict=True)]))

    def pull(chosen: Sequence[int]) -> tuple[Floats, Floats]:
        directions = []
        for basis, root in zip(seen, part.roots(chosen), strict=True):
            longest = np.linalg.svd(basis @ root)[0][:, 0]
            directions.append(root @ (root.T @ (basis.T @ longest)))
        return np.array(directions)[:, None], np.full((draws, 1), 1.0 / draws)

    return Criterion("E", part, if_added, value, pull)


#: Criteria by the name a user gives: worst task, mean over tasks, trace, determinant, largest eigenvalue, index O1.
CRITERIA: dict[str, Callable[[Design, Floats], Criterion]] = {
    "worst": worst_task,
    "I": mean_task,
    "A": mean_parameter,
    "D": volume,
    "E": worst_direction,
    "O1": observability_index,
}


def criterion_by_name(name: str, design: Design, reference: Floats) -> Criterion:
    """The criterion called `name` in `CRITERIA`; `InputError` if none is."""
    if name not in CRITERIA:
        raise InputError(f"unknown criterion {name!r}: expected one of {', '.join(CRITERIA)}")
    return CRITERIA[name](design, reference)


def _widened(base: Floats) -> Floats:
    """Roots of the information before any candidate, the prior's share being as flat as the rows are scaled up."""
    n = base.shape[-1]
    measured = base.transpose(0, 2, 1) @ base - np.eye(n)
    rows = np.array([covariance_root(one, np.ones(n)).T for one in measured]) * _FLAT
    identity = np.broadcast_to(np.eye(n), base.shape)
    return np.linalg.qr(np.concatenate([identity, rows], axis=1), mode="r")
