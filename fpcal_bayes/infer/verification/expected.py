"""What a fit expects of sweeps that it was not made from, and how far they are from it.

With v the standard normal scores of the geometry's prior, w the weights of the error motions and e the noise, all rows
are r = G v + B w + e, linear at the fit. Given the fitted rows R, the fresh rows F are normal for fixed scales,

    e_F = r_F - K_FR K_RR^-1 r_R,      S = K_FF - K_FR K_RR^-1 K_RF.

The score T = e_F' S^-1 e_F is what the sum of squares of data and prior rises by when the fresh rows join the fit.
It is taken so, by fitting both: along directions that the fitted rows do not see the surface bends, and no line holds.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.minimise import minimise
from fpcal_bayes.infer.fit.noise import Whitening, whitening_of
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.infer.mechanics.rows import RowNoise
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.mechanics import Design, Terms, design

#: Covariances of rows by rows are made.
_MOST_ROWS = 3000
_SCALES, _DRAWS_PER_SCALE = 50, 400


@dataclass(frozen=True)
class Expected:
    """The rows of a fit and fresh ones together, linear at the fit."""

    problem: Problem  # of all rows, without a whitening of its own
    fitted: Bools  # rows that the fit was made from, shape (n,)
    unknowns: Floats  # where the fit is, shape (n_free,)
    geometry: Floats  # G, shape (n, n_free), in um
    drift: Floats  # what the geometry may have drifted until each row, by unit weights, shape (n, n_drift), in um
    log_scales: Floats  # logarithms of the scales of the error motions, draws (n_draws, n_scales)
    design: Design | None = None  # of the error motions, or None: a perfect mechanism
    terms: Terms | None = None

    @classmethod
    def of(cls, found: Identification, sweeps: Sweeps, fitted: Bools, drift: Floats | None = None) -> "Expected":
        """The rows that `found` was made from, picked by `fitted` (n,), beside fresh ones; `drift` as in `verify`."""
        problem, unknowns = found.problem, found.solution.unknowns
        if len(sweeps) > _MOST_ROWS:
            raise InputError(f"{sweeps.file}: {len(sweeps)} rows, expected at most {_MOST_ROWS} for a verification")
        if problem.considered is not None:
            raise InputError("parameters are held at an earlier estimate: expected one with all parameters free")
        model = problem.model
        rows = sweeps.laid_out(model)
        values = problem.values(unknowns)
        predicted, jacobian = model.predict_with_jacobian(values, rows)
        # The sign of a row that is known by its size alone is the expected one.
        target = np.where(sweeps.signed | sweeps.absolute, sweeps.dl, np.copysign(sweeps.dl, predicted))
        target[fitted] = problem.target
        joint = replace(
            problem, sweeps=sweeps, rows=rows, target=target, whitening=Whitening(1.0 / sweeps.sigma), sensitivity=None
        )
        drifting = np.zeros((len(sweeps), 0)) if drift is None else np.where(fitted[:, None], 0.0, jacobian @ drift)
        made, terms, log = None, None, np.zeros((1, 0))
        if found.machine is not None:
            terms = found.machine.terms
            driven = drive_of_sweeps(sweeps, terms.sizes.minutes_per_sweep, terms.still)
            made = design(terms, model.vector(values), driven, sweeps.sigma)
            log = found.machine.scales.log[:: max(1, len(found.machine.scales.log) // _SCALES)]
        return cls(joint, fitted, unknowns, problem.prior.by_scores(jacobian, unknowns), drifting, log, made, terms)

    @cached_property
    def typical(self) -> Floats:
        """Logarithms of the typical scales, shape (n_scales,)."""
        return np.asarray(self.log_scales.mean(axis=0))

    @cached_property
    def innovation(self) -> Floats:
        """The fresh rows minus what is expected of them, to first order, in um, shape (n_fresh,)."""
        at = self.unknowns
        predicted = self.problem.model.predict(self.problem.values(at), self.problem.rows)
        miss = self.problem.target - predicted + self.geometry @ at
        return np.asarray(miss[~self.fitted] - self.known[0] @ miss[self.fitted])

    @cached_property
    def known(self) -> tuple[Floats, Floats]:
        """`conditional` at the typical scales: the gain K_FR K_RR^-1, and S in um^2."""
        return self.conditional(self.typical)

    @property
    def covariance(self) -> Floats:
        """S at the typical scales, in um^2, shape (n_fresh, n_fresh)."""
        return self.known[1]

    @cached_property
    def taken_up(self) -> Floats:
        """What geometry and error motions take up of the fitted rows, at the typical scales, shape (n, n_fitted)."""
        columns = np.hstack([self.geometry, self.weights_columns(self.typical)])[self.fitted]
        noise = self._base(self.typical, np.flatnonzero(self.fitted)).unwhiten(np.eye(len(columns)))
        factor = linalg.cho_factor(columns @ columns.T + noise @ noise.T, lower=True)
        return np.asarray(linalg.cho_solve(factor, columns).T)

    def conditional(self, log: Floats) -> tuple[Floats, Floats]:
        """Gain (n_fresh, n_fitted) and covariance (n_fresh, n_fresh) of the fresh rows at scales exp(log)."""
        columns, base = self._parts(log)
        columns = np.hstack([self.geometry, columns, base.unwhiten(np.eye(len(self.fitted)))])
        fitted, fresh = columns[self.fitted], columns[~self.fitted]
        gain = linalg.cho_solve(linalg.cho_factor(fitted @ fitted.T, lower=True), fitted @ fresh.T).T
        rest = fresh - gain @ fitted
        return gain, rest @ rest.T

    def weights_columns(self, log: Floats) -> Floats:
        """What error motions of unit weight add to the rows at scales exp(log), shape (n, n_weights), in um."""
        if self.design is None:
            return self.problem.sweeps.scaled[:, None]
        return np.asarray(self.design.matrix * np.exp(log)[self.design.scale])

    def score(self) -> float:
        """T: by how much the sum of squares of data and prior rises when the fresh rows join."""
        columns, base = self._parts(self.typical)
        both = replace(self.problem, whitening=MarginalWhitening.around(base, columns))
        # Whitened alone, the fitted rows know nothing of the fresh ones.
        kept = np.flatnonzero(self.fitted)
        sweeps, whitening = self.problem.sweeps.take(kept), self._base(self.typical, kept)
        rows, whitening = sweeps.laid_out(self.problem.model), MarginalWhitening.around(whitening, columns[kept])
        alone = replace(self.problem, sweeps=sweeps, rows=rows, target=self.problem.target[kept], whitening=whitening)
        before = minimise(alone, self.unknowns)
        return max(minimise(both, before.unknowns).sum_of_squares - before.sum_of_squares, 0.0)

    def p_value(self, score: float, *, seed: int = 0) -> float:
        """Probability of a larger score if the fit is right, over what is unknown of the scales."""
        n = int((~self.fitted).sum())
        if self.design is None:
            return chi2_tail(score, n)
        rng = np.random.default_rng(seed)
        lower = linalg.cholesky(self.covariance, lower=True)
        larger = []
        for log in self.log_scales:
            _, spread = self.conditional(log)
            half = linalg.solve_triangular(lower, spread, lower=True)
            sizes = linalg.eigvalsh(linalg.solve_triangular(lower, half.T, lower=True))
            larger.append(float((rng.chisquare(1.0, (_DRAWS_PER_SCALE, n)) @ sizes >= score).mean()))
        return (float(np.mean(larger)) * len(larger) * _DRAWS_PER_SCALE + 1.0) / (len(larger) * _DRAWS_PER_SCALE + 1.0)

    def _parts(self, log: Floats) -> tuple[Floats, Whitening]:
        """Columns of error motions and drift, and the whitening of the noise, of all rows at scales exp(log)."""
        return np.hstack([self.weights_columns(log), self.drift]), self._base(log, np.arange(len(self.fitted)))

    def _base(self, log: Floats, chosen: Ints) -> Whitening:
        sweeps = self.problem.sweeps.take(chosen)
        if self.design is None:
            return whitening_of(self.problem.model, sweeps, self.problem.values(self.unknowns))
        part = {name: getattr(self.design, name)[chosen] for name in ("returned", "reached_start", "reached_end")}
        noise = RowNoise.of(sweeps, replace(self.design, matrix=self.design.matrix[chosen], **part))
        return noise.whitening(float(np.exp(log[-1])), float(np.exp(log[-2])))
