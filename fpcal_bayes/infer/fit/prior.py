"""The prior of the free parameters as a function of standard normal scores."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import symmetric_root
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.priors import Marginal

#: Of a joint normal prior: eigenvalues of the scaled covariance below this are rounding.
_LEAST_EIGENVALUE = 1e-16
#: Of integrals over a standard normal score (Gauss and Hermite).
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(40)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
#: A joint normal whose correlation matrix has a lower eigenvalue is thin along a surface that bends.
_THIN = 1e-5
BENT = (
    "the prior is the normal approximation of what sweeps said, whose surface bends: no band made with it holds; "
    "expected the sweeps themselves (--prior with an estimate that carries its rows, or --session a,b)"
)


def bends(estimate: Estimate) -> bool:
    """Whether values and covariance stand for a surface that is thin beside its extent: a posterior of sweeps."""
    sd = np.sqrt(np.diag(estimate.covariance))
    there = np.flatnonzero(sd)
    correlation = estimate.covariance[np.ix_(there, there)] / np.outer(sd[there], sd[there])
    return len(there) > 0 and float(linalg.eigvalsh(correlation)[0]) < _THIN


@dataclass(frozen=True)
class Prior:
    """Prior of some parameters: a parameter vector is a function of scores that are independent standard normal."""

    mean: Floats  # in um and rad, shape (n,); the nominal value where the prior is not normal
    sd: Floats  # in um and rad, shape (n,)
    others: tuple[tuple[int, Marginal], ...] = ()  # positions of the parameters whose priors are not normal, with these
    factor: Floats | None = None  # root of the covariance, (n, n), where the prior is jointly normal

    @classmethod
    def of(cls, parameters: ParameterSet) -> "Prior":
        """Independent priors, as the cell states them."""
        others = tuple((i, p.prior) for i, p in enumerate(parameters) if p.prior is not None)
        return cls(parameters.nominal, parameters.prior_sd, others)

    @classmethod
    def joint(cls, parameters: ParameterSet, estimate: Estimate) -> "Prior":
        """Jointly normal, as an estimate has it; what it does not hold, or holds as exact, as the cell states."""
        alone = cls.of(parameters)
        known = dict(zip(estimate.parameters.names, np.diag(estimate.covariance) > 0, strict=True))
        names = [name for name in parameters.names if known.get(name, False)]
        if not names:
            return alone
        at = parameters.positions(names)
        values, covariance = estimate.block(names)
        mean, sd = alone.mean.copy(), alone.sd.copy()
        mean[at], sd[at] = values, np.sqrt(np.diag(covariance))
        root = symmetric_root(covariance / np.outer(sd[at], sd[at]), least=_LEAST_EIGENVALUE, eigh=linalg.eigh)
        factor = np.diag(sd)
        factor[np.ix_(at, at)] = sd[at, None] * root
        return cls(mean, sd, tuple((i, other) for i, other in alone.others if i not in at), factor)

    def values(self, scores: Floats) -> Floats:
        """Parameters in um and rad of scores, both of shape (..., n)."""
        result: Floats = self.mean + (self.sd * scores if self.factor is None else scores @ self.factor.T)
        for i, other in self.others:
            result[..., i] = other.value(scores[..., i])
        return result

    def scores(self, values: Floats) -> Floats:
        """Scores of one parameter vector (n,); `InputError` if the prior excludes it."""
        result: Floats = values - self.mean
        result = result / self.sd if self.factor is None else linalg.solve(self.factor, result)
        for i, other in self.others:
            result[i] = other.score(values[i : i + 1])[0]
        return result

    def by_scores(self, jacobian: Floats, scores: Floats) -> Floats:
        """Derivatives (..., n_rows, n) by scores (..., n), from those by the parameters, which may be overwritten."""
        others = [(i, jacobian[..., i] * other.slope(scores[..., i])[..., None]) for i, other in self.others]
        result: Floats = jacobian @ self.factor if self.factor is not None else np.multiply(jacobian, self.sd, jacobian)
        for i, column in others:
            result[..., i] = column
        return result

    def slopes(self, scores: Floats) -> Floats:
        """Derivatives of the parameters (rows) by the scores (columns) at one point (n,), shape (n, n)."""
        return self.by_scores(np.eye(len(self.mean)), scores)

    def secants(self, scores: Floats, sd: Floats) -> Floats:
        """`slopes`, of a prior that is not normal by the values' sd over the scores' `sd` (n,): unseen, the prior's."""
        result = self.slopes(scores)
        for i, other in self.others:
            values = other.value(scores[i] + sd[i] * _NODES)
            result[i, i] = np.sqrt(_WEIGHTS @ (values - _WEIGHTS @ values) ** 2) / sd[i]
        return result
