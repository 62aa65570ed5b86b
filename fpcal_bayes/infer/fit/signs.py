"""Sweeps whose direction is not known: decide the sign of each dL together with the fit.

Rows of one whole trace have one sign. Rows are taken up as the fit comes to predict their sign. Where it predicts none
although the two signs would lead to different fits, both are followed. The minimal sum of squares of some rows can only
grow as rows are added, so a best-first search by that sum finds the best assignment, and every other one that is nearly
as good.
"""

import heapq
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from scipy import linalg, sparse, special

from fpcal_bayes.core.linalg import posterior_triangle
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.infer.fit.minimise import Solution, distinct_minima, minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.measure.sharing import Sharing

#: A predicted sign is taken when its odds exceed e^12, computed with the predictive standard deviation widened
#: threefold since the prediction is linear.
_DECISIVE_LOG_ODDS = 12.0
_WIDENING = 3.0
#: A change of less than this many standard deviations of its noise leads to much the same fit with either sign.
_SEPARABLE = 4.0
#: Assignments whose sum of squares exceeds the best by this are one in a thousand.
_RIVAL_EXCESS = 13.8
_MAX_FITS = 400
#: Most assignments that are handed on beside the best.
_MOST_RIVALS = 7
#: A sign with more than this probability of being wrong is doubtful.
DOUBTFUL = 0.01


@dataclass(frozen=True)
class SignDecision:
    """Signs of all rows."""

    target: Floats  # measured changes with their sign, shape (n_rows,)
    solution: Solution
    # probability that the sign of a row is the other one, shape (n_rows,); zero at signed rows, and of rows that have
    # one sign together at all but the last
    doubt: Floats
    complete: bool  # whether the search ended before its limit of fits
    # minima of other assignments that fit nearly as well, each away from the rest, best first
    rivals: tuple[Solution, ...]

    def rescaled(self, factor: Floats) -> "SignDecision":
        """The same where scores count `factor` (n_unknowns,) times as much."""
        return replace(self, rivals=tuple(replace(each, unknowns=each.unknowns * factor) for each in self.rivals))


def decide_signs(problem: Problem, start: Floats) -> SignDecision:
    """Decide the signs of the unsigned rows of `problem`, starting the fit at `start` (n_unknowns,)."""
    signed = problem.sweeps.signed | problem.sweeps.absolute
    tie, alike = count(), _Alike.of(problem)
    first = _Branch(problem.target.copy(), signed.copy(), Solution(start, 0.0, True))
    queue: list[tuple[float, int, _Branch]] = [(0.0, next(tie), first)]
    finished: list[_Branch] = []
    fits, best = 0, np.inf
    while queue and fits < _MAX_FITS:
        lower_bound, _, branch = heapq.heappop(queue)
        if lower_bound > best + _RIVAL_EXCESS:
            queue.clear()
            break
        for grown in branch.grow(problem, alike):
            fits += 1
            if grown.taken.all():
                settled = _settle(problem, alike, grown)
                finished.append(settled)
                best = min(best, settled.solution.sum_of_squares)
            else:
                heapq.heappush(queue, (grown.solution.sum_of_squares, next(tie), grown))
    complete = not queue
    if not finished:
        # The limit of fits is reached: follow the likeliest branch to its end by the predicted signs alone.
        branch = queue[0][2]
        told = alike.odds(problem.target, *branch.predict(problem))
        target = np.where(branch.taken, branch.target, np.copysign(1.0, told) * problem.target)
        finished = [_settle(problem, alike, _Branch(target, np.ones_like(signed), branch.solution))]
    while True:
        chosen = min(finished, key=lambda branch: branch.solution.sum_of_squares)
        flipped = _flip_doubt(problem.with_target(chosen.target), alike, chosen.solution)
        # That is linear as well: what it does not clearly exclude is fitted.
        near = flipped > np.exp(-_DECISIVE_LOG_ODDS * _WIDENING**2)
        near &= ~signed & alike.last & (alike.odds(problem.target, problem.target) >= _SEPARABLE**2)
        others = [alike.first == alike.first[row] for row in np.flatnonzero(near)]
        finished += [_settle(problem, alike, chosen.with_signs(rows, -chosen.target, problem)) for rows in others]
        if not min(each.solution.sum_of_squares for each in finished) < chosen.solution.sum_of_squares - 1e-6:
            break
    doubt = np.where(near, 0.0, flipped)
    doubt = np.where(signed | ~alike.last, 0.0, np.maximum(_rival_doubt(chosen, finished), doubt))
    most = chosen.solution.sum_of_squares + _RIVAL_EXCESS
    alike_good = [branch.solution for branch in finished if branch.solution.sum_of_squares < most]
    rivals = distinct_minima(problem.with_target(chosen.target), chosen.solution, alike_good)[:_MOST_RIVALS]
    return SignDecision(chosen.target, chosen.solution, doubt, complete, rivals)


def signed_as(problem: Problem, predicted: Floats) -> Floats:
    """Measured changes of the rows with the signs that predictions (n_rows,) in um give those that have none."""
    told = _Alike.of(problem).odds(problem.target, predicted)
    known = problem.sweeps.signed | problem.sweeps.absolute
    return np.where(known, problem.target, np.copysign(1.0, told) * problem.target)


@dataclass(frozen=True)
class _Alike:
    """Which rows have one sign: those of a whole trace, whose changes are known up to a sign of all."""

    first: Ints  # the first row that has the sign of each, shape (n_rows,)
    variance: Floats  # of each row's noise in um^2, shape (n_rows,)
    blocks: tuple[tuple[Ints, Floats], ...]  # rows of one sign where there are several, covariance of their noise

    @classmethod
    def of(cls, problem: Problem) -> "_Alike":
        sweeps, first = problem.sweeps, np.arange(len(problem.target))
        whole = sweeps.common.any(axis=1) & ~sweeps.signed
        if not whole.any():
            return cls(first, problem.whitening.variance, ())
        first[whole] = Sharing.of(sweeps).reading[whole]
        root = problem.whitening.unwhiten(np.eye(len(first)))
        parts = [np.flatnonzero(whole & (first == at)) for at in np.unique(first[whole])]
        return cls(first, problem.whitening.variance, tuple((rows, root[rows] @ root[rows].T) for rows in parts))

    @property
    def last(self) -> Bools:
        """Whether each row is the last one of its sign."""
        place = np.arange(len(self.first))
        at = place.copy()
        at[self.first] = place
        return np.asarray(at[self.first] == place)

    def odds(self, target: Floats, predicted: Floats, spread: Floats | None = None) -> Floats:
        """Half the log odds of the signs of `target`; predicted: um; spread: a root (n, n_rows) of its covariance."""
        told = target * predicted / (self.variance + (0.0 if spread is None else (spread**2).sum(axis=0)))
        for rows, noise in self.blocks:
            covariance = noise if spread is None else noise + spread[:, rows].T @ spread[:, rows]
            told[rows] = target[rows] @ np.linalg.solve(covariance, predicted[rows])
        return told


@dataclass(frozen=True)
class _Branch:
    """An assignment of signs to the rows taken so far, and the fit to them."""

    target: Floats
    taken: Bools
    solution: Solution

    def predict(self, problem: Problem) -> tuple[Floats, Floats]:
        """Predicted change of every row in um, and a root of the covariance of all, shape (n_unknowns, n_rows)."""
        unknowns = self.solution.unknowns
        n = problem.n_free
        predicted, jacobian = problem.model.predict_with_jacobian(problem.values(unknowns), problem.rows)
        scaled = problem.prior.by_scores(jacobian, unknowns[:n])
        if problem.sensitivity is not None:
            predicted = predicted + problem.sensitivity @ unknowns[n:]
            scaled = np.hstack([scaled, problem.sensitivity])
        seen = np.zeros((0, problem.n_unknowns))
        if self.taken.any():
            seen = problem.take(self.taken).relinearised(unknowns).data_jacobian(unknowns)
        return predicted, linalg.solve_triangular(posterior_triangle(seen), scaled.T, trans="T")

    def grow(self, problem: Problem, alike: _Alike) -> list["_Branch"]:
        """Take up every row whose sign is clear; where none is, follow both signs of the row that tells most."""
        branch = self if not self.taken.any() else self.refitted(problem)
        predicted, spread = branch.predict(problem)
        size, open_rows = problem.target, ~branch.taken
        told = alike.odds(size, predicted, spread)
        clear = open_rows & (2.0 * np.abs(told) / _WIDENING**2 > _DECISIVE_LOG_ODDS)
        if not clear.any() and alike.odds(size, size)[open_rows].max() < _SEPARABLE**2:
            # What is left is noise: its sign hardly matters to the fit.
            clear = open_rows
        if clear.any():
            return [branch.with_signs(clear, np.copysign(1.0, told) * size, problem)]
        row = int(np.argmax(np.where(open_rows, alike.odds(size, size, spread), -np.inf)))
        chosen = alike.first == alike.first[row]
        return [branch.with_signs(chosen, sign * size, problem) for sign in (1.0, -1.0)]

    def refitted(self, problem: Problem) -> "_Branch":
        """The same assignment, fitted."""
        part = problem.with_target(self.target).take(self.taken)
        return _Branch(self.target, self.taken, minimise(part, self.solution.unknowns))

    def with_signs(self, rows: Bools, target: Floats, problem: Problem) -> "_Branch":
        """The assignment with `rows` taken at `target`, fitted."""
        return _Branch(np.where(rows, target, self.target), self.taken | rows, self.solution).refitted(problem)


def _settle(problem: Problem, alike: _Alike, branch: _Branch) -> _Branch:
    """Flip rows whose sign the fit contradicts, and fit again, until none is left."""
    unsigned = ~(problem.sweeps.signed | problem.sweeps.absolute)
    for _ in range(10):
        predicted = problem.model.predict(problem.values(branch.solution.unknowns), problem.rows)
        if problem.sensitivity is not None:
            predicted = predicted + problem.sensitivity @ branch.solution.unknowns[problem.n_free :]
        told = alike.odds(problem.target, predicted)
        target = np.where(unsigned, np.copysign(1.0, told) * problem.target, branch.target)
        if (target == branch.target).all():
            return branch
        flipped = _Branch(target, branch.taken, branch.solution).refitted(problem)
        if flipped.solution.sum_of_squares >= branch.solution.sum_of_squares:
            return branch
        branch = flipped
    return branch


def _rival_doubt(chosen: _Branch, finished: list[_Branch]) -> Floats:
    """Probability of the other sign of each row among the complete assignments."""
    excess = np.array([branch.solution.sum_of_squares for branch in finished]) - chosen.solution.sum_of_squares
    # The same assignment may be reached twice: it counts once.
    distinct = np.unique(np.array([branch.target for branch in finished]), axis=0, return_index=True)[1]
    weights = np.exp(-0.5 * excess[distinct])
    return np.asarray(weights @ np.array([finished[i].target != chosen.target for i in distinct]) / weights.sum())


def _flip_doubt(problem: Problem, alike: _Alike, solution: Solution) -> Floats:
    """Probability of the other sign of each row when that sign alone is flipped and the fit follows linearly."""
    unknowns = solution.unknowns
    residuals = problem.data_residuals(unknowns)
    orthonormal = linalg.qr(problem.jacobian(unknowns), mode="economic")[0][: len(residuals)]
    n = len(alike.first)
    flips = sparse.csc_array((2.0 * problem.target, (np.arange(n), alike.first)), shape=(n, n))
    change = sparse.csc_array(problem.whitening.as_matrix @ flips)
    excess = 2.0 * (change.T @ residuals) + change.multiply(change).sum(axis=0)
    return np.asarray(special.expit(-0.5 * (excess - ((change.T @ orthonormal) ** 2).sum(axis=1))))[alike.first]
