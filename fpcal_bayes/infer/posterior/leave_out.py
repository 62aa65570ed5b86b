"""How well a model predicts each row from all the others: leave-one-out, without a run for each row where possible.

Draws of the whole posterior are weighted by one over the density of the row that is left out, with the tail of the
weights smoothed (PSIS, Vehtari, Gelman, Gabry 2017). Where the shape k of that tail says that the weights cannot be
trusted, the row is left out in earnest: the posterior without it is fitted anew and drawn from by importance sampling
in its own charts, and the ratio of both normalising constants is taken by bridge sampling (Meng, Wong 1996).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.minimise import distinct_minima, minimise, solution_rank
from fpcal_bayes.infer.posterior.draws import (
    MOST_K,
    Likelihood,
    Posterior,
    WeightedDraws,
    charted_draws,
    smoothed_weights,
)
from fpcal_bayes.infer.posterior.proposal import in_parts
from fpcal_bayes.infer.posterior.target import PosteriorTarget

#: What draws of a posterior without one row are worth, and draws of the whole one that are set against them.
_REFIT_DRAWS = 300
_WHOLE_DRAWS = 4096
#: Weights of a larger k have no variance: a row with it is left out in earnest where that may be.
_SURE_K = 0.5
#: Draws, and draws times rows, that are looked at; of longer runs evenly spaced ones.
_MOST_DRAWS, _MOST_CELLS = 16_384, 10_000_000
_AT_ONCE = 256
_BRIDGE_STEPS = 200
#: Log densities closer together than this are the same.
_SAME = 1e-9


@dataclass(frozen=True)
class LeaveOneOut:
    """Log density of each row given all others."""

    elpd_rows: Floats  # shape (n_rows,), per um
    bound_rows: Floats  # given all rows, itself among them: never below the exact value of `elpd_rows`
    pareto_k: Floats  # shape of the tail of each row's weights, shape (n_rows,)
    good_k: float  # up to this k the weights are good enough (Vehtari, Simpson, Gelman, Yao, Gabry 2024)
    refitted: Bools  # rows that were left out in earnest, shape (n_rows,)

    @property
    def bad(self) -> Bools:
        """Rows whose weights cannot be trusted, shape (n_rows,)."""
        return ~(self.pareto_k <= self.good_k)

    @property
    def open(self) -> Bools:
        """Rows of them that could not be left out in earnest: their upper bound stands there."""
        return self.bad & ~self.refitted

    @property
    def elpd(self) -> float:
        """Sum over the rows."""
        return float(self.elpd_rows.sum())

    @property
    def se(self) -> float:
        """Standard error of the sum, from the scatter of the rows."""
        return standard_error(self.elpd_rows)

    @property
    def p_loo(self) -> float:
        """Effective number of parameters: what knowing a row adds to its own density."""
        return float((self.bound_rows - self.elpd_rows).sum())


def standard_error(rows: Floats) -> float:
    """Standard error of the sum of independent terms (n_rows,)."""
    return float(np.sqrt(len(rows) * np.var(rows)))


def leave_one_out(posterior: Posterior, likelihood: Likelihood, *, most_refits: int, seed: int = 0) -> LeaveOneOut:
    """From a converged posterior; if more rows than `most_refits` need it, none is left out in earnest."""
    n_rows, n = len(posterior.target.problem.target), posterior.points.shape[-1]
    every = -(-posterior.log_density.size // min(_MOST_DRAWS, _MOST_CELLS // n_rows))
    points = posterior.points[:, ::every].transpose(0, 2, 1, 3).reshape(-1, n)
    effective = min(float(np.mean(posterior.diagnostics.ess_bulk)) / len(points), 1.0)
    known = WeightedDraws(posterior.target, points, np.zeros(len(points)), effective)
    return left_out_each(posterior.identification, known, likelihood, most_refits=most_refits, seed=seed)


def left_out_each(
    identification: Identification, known: WeightedDraws, likelihood: Likelihood, *, most_refits: int, seed: int = 0
) -> LeaveOneOut:
    """The same from weighted draws."""
    points, log_weights = known.points, special.log_softmax(known.log_weights)
    rows = rows_given_others(known.target, points)
    weighted = [_smoothed(row, log_weights, known.independent) for row in rows.T]
    result = LeaveOneOut(
        elpd_rows=np.array([elpd for elpd, _ in weighted]),
        bound_rows=special.logsumexp(rows + log_weights[:, None], axis=0),
        pareto_k=np.array([k for _, k in weighted]),
        good_k=min(1.0 - 1.0 / np.log10(len(points)), MOST_K),
        refitted=np.zeros(rows.shape[1], dtype=bool),
    )
    rng = np.random.default_rng(seed)
    again = np.flatnonzero(~(result.pareto_k <= min(_SURE_K, result.good_k)))
    again = again if len(again) <= most_refits else np.flatnonzero(result.bad)
    for row in again.tolist() if len(again) <= most_refits else []:
        some = rng.choice(len(points), _WHOLE_DRAWS, p=np.exp(log_weights))
        exact = _left_out(identification, known.target, likelihood, row, rows[some, row], rng)
        if exact is not None:
            result.elpd_rows[row], result.refitted[row] = exact, True
    result.elpd_rows[result.open] = result.bound_rows[result.open]
    return result


def _smoothed(row: Floats, log_weights: Floats, independent: float) -> tuple[float, float]:
    """Leave-one-out density of a row and its k, from its log densities at draws (n_draws,) of normalised weights."""
    if np.ptp(row - log_weights) < _SAME:
        # No draw matters more than another.
        return float(special.logsumexp(row) - np.log(len(row))), 0.0
    left, k = smoothed_weights(log_weights - row, independent)
    return (float(special.logsumexp(left + row)), k) if np.isfinite(k) else (float(row.min()), k)


def rows_given_others(target: PosteriorTarget, points: Floats) -> Floats:
    """Log density of each row given the parameters and all other rows, per um, shape (n_points, n_rows)."""
    return np.concatenate([target.row_given_others(points[part]) for part in in_parts(len(points), _AT_ONCE)])


def without_row(identification: Identification, row: int) -> Identification | None:
    """Problem and minima of an identification without one row; None if no minimum is found from those with it."""
    problem = identification.problem
    reduced = problem.take(np.arange(len(problem.target)) != row).relinearised(identification.solution.unknowns)
    found = [minimise(reduced, minimum.unknowns) for minimum in (identification.solution, *identification.other_minima)]
    best = min(found, key=solution_rank)
    if not best.converged:
        return None
    return replace(identification, problem=reduced, solution=best, other_minima=distinct_minima(reduced, best, found))


def _left_out(
    identification: Identification,
    whole: PosteriorTarget,
    likelihood: Likelihood,
    row: int,
    with_row: Floats,
    rng: np.random.Generator,
) -> float | None:
    """Log density of a row given the others, the posterior being drawn without it; None if that fails."""
    reduced = without_row(identification, row)
    if reduced is None:
        return None
    known = charted_draws(reduced, likelihood, _REFIT_DRAWS, rng)
    if known is None:
        return None
    weights = np.exp(smoothed_weights(known.log_weights)[0])
    return _bridge(with_row, rows_given_others(whole, known.points)[:, row], weights, known.worth)


def _bridge(with_row: Floats, without: Floats, weights: Floats, effective: float) -> float:
    """Log mean of exp(`without`) under `weights`, steadied by log densities at draws that the row pulled near."""
    share = len(with_row) / (len(with_row) + effective)
    log_weights = np.log(np.maximum(weights, 1e-300))
    ratio = float(special.logsumexp(without + log_weights))
    for _ in range(_BRIDGE_STEPS):
        down = np.logaddexp(np.log(share) + without, np.log1p(-share) + ratio)
        up = np.logaddexp(np.log(share) + with_row, np.log1p(-share) + ratio)
        last = ratio
        over = special.logsumexp(without - down + log_weights)
        ratio = float(over - (special.logsumexp(-up) - np.log(len(with_row))))
        if abs(ratio - last) < 1e-6:
            break
    return ratio
