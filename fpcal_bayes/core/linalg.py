"""Linear algebra and distributions that every room needs; each formula stands here once."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, special

from fpcal_bayes.core.typing import Floats

#: Eigenvalues and eigenvectors of a symmetric matrix. NumPy and SciPy call LAPACK routines whose last digits differ:
#: callers name the one that their results were always made with.
Eigh = Callable[[Floats], Any]


def covariance_root(covariance: Floats, scale: Floats | None = None, *, eigh: Eigh = np.linalg.eigh) -> Floats:
    """A root of a `covariance` (n, n), maybe singular; rounding is judged in units of `scale`, by default its sd."""
    if scale is None:
        own = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        scale = np.where(own > 0, own, 1.0)
    values, vectors = eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.clip(values, 0.0, None)))


def symmetric_root(covariance: Floats, *, least: float = 0.0, eigh: Eigh = np.linalg.eigh) -> Floats:
    """The symmetric matrix whose square is `covariance` (n, n), eigenvalues raised to `least`; only it is smooth."""
    values, vectors = eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.clip(values, least, None))) @ vectors.T)


def posterior_triangle(jacobian: Floats) -> Floats:
    """Upper triangular R with R'R = J'J + 1, of whitened, prior-scaled rows J (n_rows, n); shape (n, n)."""
    return np.asarray(linalg.qr(np.vstack([jacobian, np.eye(jacobian.shape[1])]), mode="raw")[1])


def symmetric(matrix: Floats) -> Floats:
    """A matrix without the skew part that rounding leaves."""
    return 0.5 * (matrix + matrix.T)


@cache
def identity(n: int) -> Floats:
    """The identity of shape (n, n), made once and read-only: a step of a small filter costs little more than it."""
    made = np.eye(n)
    made.flags.writeable = False
    return made


def quantile_band(values: Floats, share: ArrayLike, axis: int | None = None) -> Floats:
    """Lower and upper edge of the central band that holds `share` of the values; the edges come first in the shape."""
    share = np.asarray(share)
    return np.asarray(np.quantile(values, np.stack([(1.0 - share) / 2.0, (1.0 + share) / 2.0], axis=-1), axis=axis))


def chi2_tail(value: float, dof: float) -> float:
    """Probability that a chi-square variable with `dof` degrees of freedom exceeds `value`."""
    return float(special.gammaincc(dof / 2.0, value / 2.0))


def finite(value: float) -> float | None:
    """A number as JSON has it: None in place of one that is not finite."""
    return float(value) if np.isfinite(value) else None


def plain(square: float, places: int = 1) -> str:
    """A sum of squares for a sentence, with so many decimals, or few digits and an exponent where it is large."""
    return f"{square:.{places}f}" if abs(square) < 1e5 else f"{square:.3g}"


def chance(p: float) -> str:
    """A probability for a sentence; what is too small for a number is not said to be zero."""
    return f"p = {p:.2g}" if p > 0.0 else "p < 1e-300"


def listed(names: Sequence[str]) -> str:
    """One name or several for a sentence: a, b and c."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def counted(n: int, what: str) -> str:
    """A number of things for a sentence: 1 sweep, 2 sweeps."""
    return f"{n} {what}{'' if n == 1 else 's'}"
