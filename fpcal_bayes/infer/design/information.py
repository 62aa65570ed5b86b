"""The design problem: candidate rows and task derivatives over draws, and what a choice of candidates leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.kernels import add_gains, worst_points


@dataclass(frozen=True)
class Design:
    """Candidates and tasks, linearised at draws, in units in which the present covariance is the identity."""

    rows: Floats  # whitened rows of each candidate, shape (n_draws, n_candidates, k, n)
    tasks: Floats  # derivatives of all task points in um, shape (n_draws, n_points, n)
    # names, task_of_point: the tasks, and which one each point belongs to, shape (n_points,)
    names: tuple[str, ...]
    task_of_point: Ints
    base: Floats  # upper triangular root of the information before any candidate, shape (n_draws, n, n)

    @classmethod
    def of(
        cls, rows: Floats, tasks: Mapping[str, Floats], covariance: Floats | None = None, known: Floats | None = None
    ) -> "Design":
        """Set up a design.

        Given are whitened rows of each candidate by the state (n_draws, n_candidates, k, n), derivatives of each task
        by it in um (n_draws, n_points, n), its covariance before any measurement (n, n), which may be singular and by
        default is the identity, and whitened rows of what is measured anyway (n_draws, n_rows, n).
        """
        n_draws, n = len(rows), rows.shape[-1]
        points = np.concatenate(
            [np.broadcast_to(jacobian, (n_draws, *jacobian.shape[1:])) for jacobian in tasks.values()], axis=1
        )
        of_point = np.repeat(np.arange(len(tasks)), [jacobian.shape[1] for jacobian in tasks.values()])
        if covariance is not None:
            root = covariance_root(covariance, eigh=linalg.eigh)
            rows, points, known = rows @ root, points @ root, None if known is None else known @ root
            n = root.shape[1]
        base = np.broadcast_to(np.eye(n), (n_draws, n, n))
        if known is not None:
            base = np.linalg.qr(np.concatenate([base, known], axis=1), mode="r")
        return cls(np.ascontiguousarray(rows), np.ascontiguousarray(points), tuple(tasks), of_point, base)

    @property
    def n_candidates(self) -> int:
        """How many candidates there are."""
        return int(self.rows.shape[1])

    @property
    def n_parameters(self) -> int:
        """Size of the state."""
        return int(self.rows.shape[-1])

    def roots(self, chosen: Sequence[int]) -> Floats:
        """Roots of the covariance after the chosen candidates: C = root root', shape (n_draws, n, n)."""
        triangle = self.base
        if len(chosen):
            n_draws, n = len(self.rows), self.n_parameters
            added = self.rows[:, list(chosen)].reshape(n_draws, -1, n)
            triangle = np.linalg.qr(np.concatenate([self.base, added], axis=1), mode="r")
        return np.linalg.inv(triangle)

    def task_variance(self, chosen: Sequence[int]) -> Floats:
        """Variance at every task point after the chosen candidates, in um^2, shape (n_draws, n_points)."""
        scaled = self.tasks @ self.roots(chosen)
        return (scaled**2).sum(axis=-1)

    def worst_points(self, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Variance of each task's worst point after the chosen candidates, in um^2, shape (n_draws, n_tasks).

        Beside it the covariance times the derivatives of that point, shape (n_draws, n_tasks, n).
        """
        n_draws, n, n_tasks = len(self.rows), self.n_parameters, len(self.names)
        variance, directions = np.empty((n_draws, n_tasks)), np.empty((n_draws, n_tasks, n))
        rows = self.rows[:, list(chosen)].reshape(n_draws, -1, n)
        worst_points(self.information, rows, self.tasks, self.task_start, variance, directions)
        return variance, directions

    @cached_property
    def information(self) -> Floats:
        """Information before any candidate, shape (n_draws, n, n)."""
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

    def if_added(
        self, chosen: Sequence[int], among: Ints | None = None, *, worst: bool = True, whole_state: bool = False
    ) -> tuple[Floats, Floats]:
        """What each candidate would leave if it were added to those chosen.

        Candidates are those at the positions `among`, by default all. The `worst` point of each task counts, else the
        mean over its points; with `whole_state` the parameters themselves, in their units here, stand in place of the
        tasks, as one task. Expected task variances, shape (n_candidates, n_tasks), and expected gain in the logarithm
        of the determinant of the information, shape (n_candidates,).
        """
        rows = self.rows if among is None else self.rows[:, among]
        n_draws, n_candidates, k, n = rows.shape
        task_start = np.array([0, n]) if whole_state else self.task_start
        left, gain = np.zeros((n_candidates, len(task_start) - 1)), np.zeros(n_candidates)
        for draw, root in enumerate(self.roots(chosen)):
            points = root if whole_state else self.tasks[draw] @ root
            scaled = rows[draw].reshape(-1, n) @ root
            products = (scaled @ points.T).reshape(n_candidates, k, -1)
            variances = (points**2).sum(axis=1)
            add_gains(scaled.reshape(n_candidates, k, n), products, variances, task_start, worst, left, gain)
        return left / n_draws, gain / n_draws
