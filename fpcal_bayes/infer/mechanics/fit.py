"""Fit the geometry of a machine whose error motions are marginalised."""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import Solution, descended, minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.mechanics.rows import RowNoise, scaled_whitening
from fpcal_bayes.infer.mechanics.scales import LinearRows, ScaleDensity, ScalePosterior, sample_scales
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.mechanics import Design, Drive, Mechanics, Terms, design

#: With more rows than this they are compressed, and the return's share of the noise is fitted instead of sampled.
DENSE_ROWS = 320
#: The minima of longer files are looked for with so many rows.
_THINNED = 1000
_DRAWS_PER_SCALE, _FEW_PER_SCALE = 20, 4


@dataclass(frozen=True)
class MechanicsDraws:
    """Equally likely draws of all that is unknown, for errors along tasks."""

    scores: Floats  # geometry in standard normal scores of the prior, shape (n_draws, n_unknowns)
    weights: Floats  # of the mechanics, in units of their stated sizes, shape (n_draws, n_weights)
    log_scales: Floats  # logarithms of the factors on the stated sizes, shape (n_draws, n_scales)


@dataclass(frozen=True, repr=False)
class MechanicsFit(Brief):
    """A geometry fitted under the covariance of its mechanics."""

    problem: Problem  # whose whitening marginalises the mechanics at the typical scales
    solution: Solution  # its minimum
    # terms, drive, design, noise: the weights, how the rows were driven, what the weights add to them, and what is new
    # in each row
    terms: Terms
    drive: Drive
    design: Design
    noise: RowNoise
    rows: LinearRows  # the linearised rows that the scales were drawn from
    density: ScaleDensity  # of the scales
    scales: ScalePosterior  # their posterior
    seed: int
    seconds: float  # what it took

    @property
    def values(self) -> Floats:
        """The geometry, in um and rad, shape (n_free,)."""
        return self.problem.values(self.solution.unknowns)

    @cached_property
    def draws(self) -> MechanicsDraws:
        """Draws of geometry and weights, the same for the same seed."""
        return _draw(self, _DRAWS_PER_SCALE)

    @cached_property
    def few_draws(self) -> MechanicsDraws:
        """As many as travel with an estimate."""
        return _draw(self, _FEW_PER_SCALE)

    @cached_property
    def whole_density(self) -> ScaleDensity:
        """Density of the scales by every row, however many they are."""
        if len(self.rows.target) == len(self.problem.target):
            return self.density
        at = self.solution.unknowns
        rows = _linear_rows(self.problem, self.design, self.noise, at, self.scales.mode, whole=True)
        return ScaleDensity(rows, self.terms.scales)

    @cached_property
    def factors(self) -> list[Floats]:
        """Lower Cholesky factor of the rows' covariance at each draw of the scales, geometry and weights included."""
        return [self.density.factor(log) for log in self.scales.log]

    def moments(self) -> tuple[Floats, Floats]:
        """Mean (n,) and covariance (n, n) of the geometry's scores over the scales; considered ones stay (Schmidt)."""
        n_free = self.problem.n_free
        means, spread = [], np.zeros((self.problem.n_unknowns,) * 2)
        geometry = self.rows.geometry
        for lower in self.factors:
            white = linalg.solve_triangular(lower, geometry, lower=True, check_finite=False)
            means.append(white.T @ linalg.solve_triangular(lower, self.rows.target, lower=True, check_finite=False))
            spread += np.eye(len(spread)) - white.T @ white
        centres = np.array(means)
        centres[:, n_free:] = 0.0
        spread[n_free:, n_free:] = len(centres) * np.eye(len(spread) - n_free)
        mean = centres.mean(axis=0)
        around = centres - mean
        return mean, (spread + around.T @ around) / len(centres)


def fit_mechanics(problem: Problem, sizes: Mechanics, *, start: Floats | None = None, seed: int = 0) -> MechanicsFit:
    """Fit the geometry of `problem`, rows of one session, with the mechanics of `sizes` marginalised.

    start: scaled unknowns, shape (n_unknowns,); by default the middle of the prior.
    """
    began = time.perf_counter()
    terms = Terms.of(problem.model.cell, sizes, problem.model.free.names)
    drive = drive_of_sweeps(problem.sweeps, sizes.minutes_per_sweep, terms.still)
    rng = np.random.default_rng(seed)
    unknowns = np.zeros(problem.n_unknowns) if start is None else start
    log = np.zeros(len(terms.scales))
    made, noise = _designed(problem, terms, drive, unknowns)
    for _ in range(2):
        problem = replace(problem, whitening=scaled_whitening(noise, made, log), log_scales=log)
        unknowns = descended(problem, unknowns)
        made, noise = _designed(problem, terms, drive, unknowns)
        rows = _linear_rows(problem, made, noise, unknowns, log)
        density = ScaleDensity(rows, terms.scales)
        log = density.mode(log)
    scales = sample_scales(density, log, rng)
    typical = scales.log.mean(axis=0)
    problem = replace(problem, whitening=scaled_whitening(noise, made, typical), log_scales=typical)
    solution = minimise(problem, unknowns)
    taken = time.perf_counter() - began
    return MechanicsFit(problem, solution, terms, drive, made, noise, rows, density, scales, seed, taken)


def many_rows(cell: Cell, sweeps: Sweeps) -> bool:
    """Whether the minima are looked for with some of the rows: with mechanics marginalised all cost too much."""
    return cell.mechanics is not None and len(sweeps) > _THINNED and bool((sweeps.signed | sweeps.absolute).all())


def thinned(problem: Problem) -> Problem:
    """The problem of rows spread over all of them, where they are many."""
    sweeps = problem.sweeps
    if not many_rows(problem.model.cell, sweeps):
        return problem
    chosen = np.zeros(len(sweeps), dtype=bool)
    chosen[np.linspace(0, len(sweeps) - 1, _THINNED).astype(np.int64)] = True
    return problem.take(chosen)


def _designed(problem: Problem, terms: Terms, drive: Drive, unknowns: Floats) -> tuple[Design, RowNoise]:
    made = design(terms, problem.model.vector(problem.values(unknowns)), drive, problem.sweeps.sigma)
    return made, RowNoise.of(problem.sweeps, made)


def _linear_rows(
    problem: Problem, made: Design, noise: RowNoise, unknowns: Floats, log: Floats, *, whole: bool = False
) -> LinearRows:
    """The problem linearised at `unknowns`; many rows are compressed unless the `whole` is wanted."""
    predicted, jacobian = problem.model.predict_with_jacobian(problem.values(unknowns), problem.rows)
    geometry = problem.prior.by_scores(jacobian, unknowns[: problem.n_free])
    if problem.sensitivity is not None:
        predicted = predicted + problem.sensitivity @ unknowns[problem.n_free :]
        geometry = np.hstack([geometry, problem.sensitivity])
    target = problem.target - predicted + geometry @ unknowns
    if whole or len(target) <= DENSE_ROWS:
        return LinearRows(target, geometry, made.matrix, made.scale, *noise.dense())
    return _compressed(target, geometry, made, noise, log, unknowns)


def _compressed(
    target: Floats, geometry: Floats, made: Design, noise: RowNoise, log: Floats, unknowns: Floats
) -> LinearRows:
    """The rows turned so that all but a few hundred hold nothing but noise."""
    white = noise.whitening(1.0, float(np.exp(log[-2])))
    columns = white.apply(np.hstack([geometry, made.matrix]))
    residuals = white.apply(target - geometry @ unknowns)
    # Any square root of the columns' products serves; what it loses to rounding is far below one prior sd.
    variance, vectors = linalg.eigh(columns.T @ columns)
    kept = variance > 1e-13 * variance[-1]
    root = np.sqrt(variance[kept])[:, None] * vectors[:, kept].T
    along = (vectors[:, kept] / np.sqrt(variance[kept])).T @ (columns.T @ residuals)
    n_geometry, n_kept = geometry.shape[1], len(root)
    return LinearRows(
        target=along + root[:, :n_geometry] @ unknowns,
        geometry=np.ascontiguousarray(root[:, :n_geometry]),
        weights=np.ascontiguousarray(root[:, n_geometry:]),
        scale=made.scale,
        noise=np.eye(n_kept),
        returns=np.zeros((n_kept, n_kept)),
        rest=float(residuals @ residuals - along @ along),
        rest_dof=len(target) - n_kept,
    )


def _draw(fit: MechanicsFit, count: int) -> MechanicsDraws:
    """Draw from the mixture over scales, so many each: a prior draw is corrected by what the rows say (Matheron)."""
    rng = np.random.default_rng([fit.seed, 1])
    rows, n_free = fit.rows, fit.rows.geometry.shape[1]
    n_weights = rows.weights.shape[1]
    scores, weights = [], []
    for log, lower in zip(fit.scales.log, fit.factors, strict=True):
        sd = np.exp(log)[rows.scale]
        v, w = rng.standard_normal((count, n_free)), sd * rng.standard_normal((count, n_weights))
        factors = np.exp(np.repeat(log[None, -2:], count, axis=0))
        if len(rows.target) == len(fit.problem.target):
            error = fit.noise.draw(factors[:, 1], factors[:, 0], rng)
        else:
            error = factors[:, 1:] * rng.standard_normal((count, len(rows.target)))
        miss = rows.target - v @ rows.geometry.T - w @ rows.weights.T - error
        pull = linalg.cho_solve((lower, True), miss.T, check_finite=False)
        # What is held and considered stays as it was drawn.
        v[:, : fit.problem.n_free] += pull.T @ rows.geometry[:, : fit.problem.n_free]
        scores.append(v)
        weights.append(w + sd**2 * (pull.T @ rows.weights))
    return MechanicsDraws(np.concatenate(scores), np.concatenate(weights), np.repeat(fit.scales.log, count, axis=0))
