"""The design problem: candidate rows and task derivatives over draws, what a choice leaves, how good that is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.kernels import add_left, worst_points

#: Power of the sum over tasks that stands for the worst of them: smooth enough to be climbed down, close to the worst.
_POWER = 6.0
#: Rows, as a share of the unknowns, up to which a system of the size of the rows is solved sooner.
_FEW = 0.6
#: Size of a row beside whose square the identity is lost to rounding, so that roots come from the rows themselves.
_LARGE = 1e5


@dataclass(frozen=True)
class Design:
    """Candidates and tasks, linearised at draws, in units in which the present covariance is the identity."""

    rows: Floats  # whitened rows of each candidate, shape (n_draws, n_candidates, k, n)
    tasks: Floats  # derivatives of all task points in um, shape (n_draws, n_points, n)
    # names, task_of_point: the tasks, and which one each point belongs to, shape (n_points,)
    names: tuple[str, ...]
    task_of_point: Ints
    # upper triangular root of the information before any candidate, shape (n_draws, n, n); None: the identity
    base: Floats | None = None
    # what the last sets chosen leave: the slope of a criterion asks for it where its value did
    _left: dict[tuple[int, ...], tuple[Floats, Floats]] = field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls, rows: Floats, tasks: Mapping[str, Floats], covariance: Floats | None = None, known: Floats | None = None
    ) -> "Design":
        """Of whitened rows of candidates by the state and of what is `known` anyway (n_draws, n_rows, n).

        `covariance` (n, n) before any measurement may be singular; by default it is the identity.
        """
        n_draws, n = len(rows), rows.shape[-1]
        points = np.concatenate([np.broadcast_to(j, (n_draws, *j.shape[1:])) for j in tasks.values()], axis=1)
        of_point = np.repeat(np.arange(len(tasks)), [jacobian.shape[1] for jacobian in tasks.values()])
        if covariance is not None:
            root = covariance_root(covariance, eigh=linalg.eigh)
            rows, points, known = rows @ root, points @ root, None if known is None else known @ root
            n = root.shape[1]
        base = None
        if known is not None:
            base = np.linalg.qr(np.concatenate([np.broadcast_to(np.eye(n), (n_draws, n, n)), known], axis=1), mode="r")
        return cls(np.ascontiguousarray(rows), np.ascontiguousarray(points), tuple(tasks), of_point, base)

    @property
    def n_parameters(self) -> int:
        """Size of the state."""
        return int(self.rows.shape[-1])

    def roots(self, chosen: Sequence[int]) -> Floats:
        """Roots of the covariance after the chosen candidates: C = root root', shape (n_draws, n, n)."""
        n_draws, n = len(self.rows), self.n_parameters
        base = np.broadcast_to(np.eye(n), (n_draws, n, n)) if self.base is None else self.base
        added = self.rows[:, list(chosen)].reshape(n_draws, -1, n)
        return np.linalg.inv(np.linalg.qr(np.concatenate([base, added], axis=1), mode="r"))

    def task_variance(self, chosen: Sequence[int]) -> Floats:
        """Variance at every task point after the chosen candidates, in um^2, shape (n_draws, n_points)."""
        return ((self.tasks @ self.roots(chosen)) ** 2).sum(axis=-1)

    def worst_points(self, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Variance of worst points, um^2, (n_draws, n_tasks), and covariance times their derivatives, (.., n)."""
        n_draws, n, n_tasks, key = len(self.rows), self.n_parameters, len(self.names), tuple(chosen)
        if key not in self._left:
            variance, directions = np.empty((n_draws, n_tasks)), np.empty((n_draws, n_tasks, n))
            told, rows = self._told(key), self.rows[:, list(key)].reshape(n_draws, -1, n)
            if told is None and not self._large:
                worst_points(self.information, rows, self.tasks, self.task_start, variance, directions)
            else:
                roots = self.roots(key).transpose(0, 2, 1) if told is None else told
                seen = self.tasks @ roots.transpose(0, 2, 1)
                after = (seen**2).sum(axis=-1)
                after = after if told is None else (self.tasks**2).sum(axis=-1) - after
                parts = np.split(after, self.task_start[1:-1], axis=1)
                worst = np.stack([part.argmax(axis=1) for part in parts], axis=1) + self.task_start[:-1]
                variance = np.take_along_axis(after, worst, axis=1)
                points, seen = (np.take_along_axis(part, worst[..., None], axis=1) for part in (self.tasks, seen))
                directions = seen @ roots if told is None else points - seen @ roots
            self._left.clear()
            self._left[key] = variance, directions
        return self._left[key]

    def _told(self, chosen: Sequence[int]) -> Floats | None:
        """Root of what few rows take off the identity (Woodbury), (n_draws, n_rows, n); None where rows are many."""
        rows = self.rows[:, list(chosen)].reshape(len(self.rows), -1, self.n_parameters)
        if self.base is not None or rows.shape[1] >= _FEW * self.n_parameters or self._large:
            return None
        return np.asarray(np.linalg.inv(np.linalg.cholesky(np.eye(rows.shape[1]) + rows @ rows.swapaxes(1, 2))) @ rows)

    @cached_property
    def _large(self) -> bool:
        return any(abs(part).max(initial=0.0) > _LARGE for part in (self.rows, self.base) if part is not None)

    @cached_property
    def information(self) -> Floats:
        """Information before any candidate, shape (n_draws, n, n)."""
        if self.base is None:
            return np.broadcast_to(np.eye(self.n_parameters), (len(self.rows), self.n_parameters, self.n_parameters))
        return np.ascontiguousarray(self.base.transpose(0, 2, 1) @ self.base)

    @property
    def task_start(self) -> Ints:
        """Where the points of each task start, and where the last ends, shape (n_tasks + 1,)."""
        return np.concatenate([[0], np.cumsum(np.bincount(self.task_of_point))])

    def expected_variance(self, chosen: Sequence[int], *, worst: bool = True) -> Floats:
        """Mean over the draws of each task's worst-point (or mean) variance, in um^2, shape (n_tasks,)."""
        variance = self.task_variance(chosen)
        of_task = [variance[:, self.task_of_point == task] for task in range(len(self.names))]
        return np.array([(part.max(axis=1) if worst else part.mean(axis=1)).mean() for part in of_task])

    def if_added(self, chosen: Sequence[int], *, worst: bool = True) -> Floats:
        """Task variances, um^2, if each candidate joined those chosen, (n_candidates, n_tasks): `worst` or mean."""
        n_draws, n_candidates, k, n = self.rows.shape
        left, roots = np.zeros((n_candidates, len(self.names))), self._told(chosen)
        few = roots is not None
        if self._large:
            roots = self.roots(chosen).transpose(0, 2, 1)
        elif roots is None:
            added = self.rows[:, list(chosen)].reshape(n_draws, -1, n)
            roots = np.linalg.inv(np.linalg.cholesky(self.information + added.transpose(0, 2, 1) @ added))
        for draw, root in enumerate(roots.transpose(0, 2, 1)):
            points, seen = self.tasks[draw] @ root, self.rows[draw].reshape(-1, n) @ root
            products, variances = (seen @ points.T).reshape(n_candidates, k, -1), (points**2).sum(axis=1)
            noise, sign = np.tile(np.eye(k), (n_candidates, 1, 1)), 1.0
            if few:
                alone, noise, before = (part[draw] for part in self._alone)
                products, variances, sign = alone - products, before - variances, -1.0
            seen = seen.reshape(n_candidates, k, -1)
            add_left(noise, seen, sign, products, variances, self.task_start, worst, left)
        return np.asarray(left / n_draws)

    @cached_property
    def _alone(self) -> tuple[Floats, Floats, Floats]:
        """Of candidates before any other: rows times tasks, the covariance of rows, and the variances of tasks."""
        n_draws, n_candidates, k, n = self.rows.shape
        products = self.rows.reshape(n_draws, -1, n) @ self.tasks.transpose(0, 2, 1)
        noise = np.eye(k) + self.rows @ self.rows.transpose(0, 1, 3, 2)
        return products.reshape(n_draws, n_candidates, k, -1), noise, (self.tasks**2).sum(axis=-1)


@dataclass(frozen=True)
class Criterion:
    """Expected variance of the worst task's worst point (G-optimal), or with `mean` of all (I-optimal)."""

    design: Design
    reference: Floats  # standard deviation in um that each task is judged by, shape (n_tasks,)
    mean: bool = False

    def value(self, chosen: Sequence[int]) -> float:
        """The criterion after those chosen."""
        if self.mean:
            return float(self._merit(self.design.expected_variance(chosen, worst=False)))
        return float(self._merit(self.design.worst_points(chosen)[0].mean(axis=0)))

    def if_added(self, chosen: Sequence[int]) -> Floats:
        """The criterion if each candidate were added to those chosen, shape (n_candidates,)."""
        return np.asarray(self._merit(self.design.if_added(chosen, worst=not self.mean)))

    def slope(self, chosen: Sequence[int]) -> Floats:
        """Derivative of the worst task's value by the rows of those chosen, shape (n_draws, len(chosen), k, n)."""
        # Of each task the worst point alone counts, at each draw another one: a change dW of the rows W changes its
        # variance by -2 (W u)'(dW u), u the covariance times its derivatives.
        variance, directions = self.design.worst_points(chosen)
        expected = variance.mean(axis=0)
        weights = (expected / self.reference**2 / self._merit(expected)) ** (_POWER - 1.0)
        weights = weights / self.reference**2 / len(variance)
        rows = self.design.rows[:, list(chosen)]
        seen = rows.reshape(len(rows), -1, rows.shape[-1]) @ directions.transpose(0, 2, 1) * weights
        return np.asarray((-2.0 * seen @ directions).reshape(rows.shape))

    def _merit(self, variances: Floats) -> Floats:
        """One number for variances of the tasks, shape (.., n_tasks)."""
        ratio = variances / self.reference**2
        if self.mean:
            return np.asarray(ratio.mean(axis=-1))
        largest = ratio.max(axis=-1, keepdims=True)
        return np.asarray((((ratio / largest) ** _POWER).sum(axis=-1) ** (1.0 / _POWER)) * largest[..., 0])
