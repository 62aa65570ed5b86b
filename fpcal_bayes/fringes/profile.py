"""How the cavity length can run along a sweep, before its trace is looked at.

With s from -1 at the start to 1 at the end of the sweep, L(s) - mean = c_1 P_1(s) + .. + c_D P_D(s) in Legendre
polynomials: one joint moves L as sums of sines at most, and over a sweep these few terms hold it to a fraction of a
nanometre. The cell's priors give the coefficients' mean and covariance: a translation has one mode that matters, a
rotation two. That smoothness is what tells a reversal from a fringe, and one count of fringes from another.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.kernels import legendre_table
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet

#: Legendre polynomials of a profile, from the first on.
DEGREE = 6
#: Draws from the priors, half of them on each path model; seeded, so that a trace gives the same reading every time.
_DRAWS, _SEED = 400, 20240501
#: Length over which a course that is its own stays alike, times its number of polynomials.
_SMOOTH = 6.0
#: The cell's priors are widened by this factor: they direct a fit but shall not pull it.
_WIDENED = 1.3
#: Modes of a profile whose effect stays below this, in um, are left out.
_LEAST_MODE = 1e-5
#: Nodes at which profiles are compared with their polynomials.
_NODES = 15


@dataclass(frozen=True)
class DisplacementProfile:
    """What is known of the coefficients of a sweep's profile, in um."""

    mean: Floats  # shape (DEGREE,)
    covariance: Floats  # shape (DEGREE, DEGREE)

    @cached_property
    def modes(self) -> Floats:
        """Modes of the coefficients, widened, in um (degree, n_modes): a unit of each is one standard deviation."""
        values, vectors = np.linalg.eigh(_WIDENED**2 * self.covariance)
        sds = np.sqrt(np.maximum(values, 0.0))
        return np.asarray((vectors * sds)[:, (sds > _LEAST_MODE) | (sds == sds.max())])

    @property
    def dl(self) -> float:
        """Expected change of length from start to end."""
        return float(end_weights() @ self.mean)

    @property
    def dl_sd(self) -> float:
        """Its standard deviation."""
        weights = end_weights()
        return float(np.sqrt(weights @ self.covariance @ weights))


def legendre(s: Floats, degree: int = DEGREE) -> Floats:
    """Legendre polynomials P_0 .. P_degree at `s` (n,), shape (n, degree + 1)."""
    return legendre_table(np.asarray(s, dtype=float), degree)


def end_weights(degree: int = DEGREE, ends: tuple[float, float] = (-1.0, 1.0)) -> Floats:
    """Weights (degree,) of a profile's coefficients in the change of L between two places."""
    return np.asarray(np.diff(legendre(np.array(ends), degree)[:, 1:], axis=0)[0])


def lengths_at(profile: Floats, s: Floats) -> Floats:
    """Lengths less their mean, in um, at places `s` (n,) by coefficients (degree,) of any degree."""
    return legendre(s, len(profile))[:, 1:] @ profile


def slopes_at(profile: Floats, s: Floats) -> Floats:
    """Slopes of the same, in um per unit of s."""
    n = np.arange(len(profile))
    own: Floats = (2 * n + 1) * (_below(len(n)) @ profile)
    return legendre(s, len(n) - 1) @ own


@cache
def _below(degree: int) -> Floats:
    """The slope of P_k is the sum of (2 n + 1) P_n over every other n below k: ones there, shape (degree, degree)."""
    n = np.arange(degree)
    return np.asarray(np.triu((n - n[:, None]) % 2 == 0), dtype=float)


def loosened(profile: DisplacementProfile, degree: int, size: float) -> DisplacementProfile:
    """The same for a mirror that leaves its course by a smooth random function of sd `size` in um, up to `degree`.

    It is as rough at the ends as in the middle (a Matern process with nu = 5/2; C. Rasmussen, C. Williams, Gaussian
    Processes for Machine Learning, chapter 4), which polynomials with coefficients of their own are not.
    """
    s, _ = np.polynomial.legendre.leggauss(2 * degree)
    apart = np.sqrt(5.0) * np.abs(s[:, None] - s) * degree / _SMOOTH
    project = size * np.linalg.pinv(legendre(s, degree))[1:]
    covariance = project @ ((1.0 + apart + apart**2 / 3.0) * np.exp(-apart)) @ project.T
    room = degree - len(profile.mean)
    return DisplacementProfile(np.pad(profile.mean, (0, room)), np.pad(profile.covariance, (0, room)) + covariance)


def prior_profiles(cell: Cell, sweeps: Sweeps) -> list[DisplacementProfile]:
    """Courses of sweeps by the cell's priors alone, optional parameters included, both path models taken as likely."""
    parameters = ParameterSet(p for p in cell.parameters if p.prior_sd > 0)
    generator = np.random.default_rng(_SEED)
    sds = np.array([p.prior_sd for p in parameters])
    halves = np.array_split(parameters.nominal + sds * generator.standard_normal((_DRAWS, len(parameters))), 2)
    models = [CavityModel.of(cell.with_opd(opd), parameters) for opd in ("axis", "perpendicular")]
    q, fit = nodes(sweeps, DEGREE)
    lengths = [model.predict(half, model.pose_rows(q)) for model, half in zip(models, halves, strict=True)]
    coefficients = coefficients_of(np.concatenate(lengths), fit)
    # One wild draw (a mirror turned away from the fibre) must not set the scale of all.
    centre, spread = centre_and_spread(coefficients)
    limits = 6.0 * spread + 1e-6
    kept = np.clip(coefficients, centre - limits, centre + limits)
    return [DisplacementProfile(rows.mean(axis=0), np.cov(rows.T)) for rows in kept.transpose(1, 0, 2)]


def estimated_profiles(estimate: Estimate, sweeps: Sweeps, degree: int = DEGREE) -> list[DisplacementProfile]:
    """Courses of sweeps by an estimate and its covariance, to first order, in polynomials up to `degree`."""
    model = CavityModel.of(estimate.cell, estimate.parameters)
    q, fit = nodes(sweeps, degree)
    lengths, jacobian = model.predict_with_jacobian(estimate.values, model.pose_rows(q))
    means = coefficients_of(lengths[None], fit)[0]
    slopes = coefficients_of(jacobian.T, fit)
    covariances = np.einsum("pnd,pq,qne->nde", slopes, estimate.covariance, slopes)
    return [DisplacementProfile(mean, covariance) for mean, covariance in zip(means, covariances, strict=True)]


def nodes(sweeps: Sweeps, degree: int, count: int = _NODES) -> tuple[Floats, Floats]:
    """Joint vectors at `count` nodes of all sweeps (n_sweeps * count, n_joints), what makes coefficients of values."""
    s, _ = np.polynomial.legendre.leggauss(count)
    middle, half = (sweeps.q_start + sweeps.q_end) / 2.0, (sweeps.q_end - sweeps.q_start) / 2.0
    q = middle[:, None] + s[None, :, None] * half[:, None]
    return q.reshape(-1, q.shape[2]), np.linalg.pinv(legendre(s, degree))[1:]


def coefficients_of(values: Floats, fit: Floats) -> Floats:
    """Coefficients (n_vectors, n_sweeps, degree) of values at the nodes (n_vectors, n_sweeps * count)."""
    return np.asarray(values.reshape(len(values), -1, fit.shape[1]) @ fit.T)


def centre_and_spread(draws: Floats) -> tuple[Floats, Floats]:
    """Median of draws (n, ..) and a standard deviation that a few wild ones do not set, (..) each."""
    centre = np.median(draws, axis=0)
    return centre, 1.4826 * np.median(np.abs(draws - centre), axis=0)
