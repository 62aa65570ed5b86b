"""How well data are met: chi-square, its expectation under a prior, and standardised residuals."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.problem import Problem


@dataclass(frozen=True)
class GoodnessOfFit:
    """How well the data are met at the maximum of the posterior."""

    chi2_data: float  # sum of squares of the whitened data rows
    expected: float  # its expected value: the number of rows less those that the parameters absorb
    p_value: float  # probability of a larger value if model, prior and noise are right
    standardised: Floats  # residual of each whitened row over its own standard deviation, shape (n_rows,)


def goodness_of_fit(problem: Problem, unknowns: Floats) -> GoodnessOfFit:
    """How well the data of a problem are met at `unknowns` (n_unknowns,)."""
    residuals = problem.data_residuals(unknowns)
    chi2_data = float(residuals @ residuals)
    jacobian = problem.data_jacobian(unknowns)
    orthonormal = linalg.qr(np.vstack([jacobian, np.eye(problem.n_unknowns)]), mode="economic")[0]
    leverage = (orthonormal[: len(residuals)] ** 2).sum(axis=1)
    standardised = residuals / np.sqrt(np.clip(1.0 - leverage, 1e-12, None))
    # Under the model the residuals are N(0, I - H), so their sum of squares is a sum of chi-squares with weights 1 - h,
    # h the eigenvalues of H; a scaled chi-square with the same mean and variance stands for it (Satterthwaite 1946).
    shrink = linalg.svdvals(jacobian)[: problem.n_unknowns]
    weights = np.ones(max(len(residuals), len(shrink)))
    weights[: len(shrink)] = 1.0 / (1.0 + shrink**2)
    weights = weights[: len(residuals)] if len(residuals) > len(shrink) else weights
    mean, square = float(weights.sum()), float((weights**2).sum())
    p_value = chi2_tail(chi2_data * mean / square, mean**2 / square)
    return GoodnessOfFit(chi2_data, mean, p_value, standardised)
