"""Cramer-Rao bounds: the best that any method can do with a set of sweeps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fpcal_bayes.infer.observability import spectrum_of

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Bounds:
    """Least standard deviations of the parameters, in prior standard deviations.

    Attributes
    ----------
    unbiased
        Of any unbiased estimate, without prior (Cramer 1946, Rao 1945); infinite where a direction that the data do not
        see takes part. Shape (n,).
    with_prior
        Of any estimate on average over the prior (van Trees 1968), shape (n,).
    """

    unbiased: Floats
    with_prior: Floats


def bounds_of(jacobian: Floats) -> Bounds:
    """Bounds for the parameters of a whitened, prior-scaled Jacobian (n_rows, n); the others are known exactly."""
    spectrum = spectrum_of(jacobian)
    n = jacobian.shape[1]
    seen, rank = spectrum.singular_values, spectrum.rank
    unbiased = np.sqrt(((spectrum.observable / seen[:rank, None]) ** 2).sum(axis=0))
    # Rounding gives every parameter a share of about 1e-13 in the null space.
    unbiased[spectrum.null_share > 1e-12] = np.inf
    triangle = linalg.qr(np.vstack([jacobian, np.eye(n)]), mode="r")[0][:n]
    with_prior = np.linalg.norm(linalg.solve_triangular(triangle, np.eye(n)), axis=1)
    return Bounds(unbiased, with_prior)
