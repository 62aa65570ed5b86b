"""The signal of a sweep fitted as a whole: profile, phase, offset, gain, visibility and cyclic error together.

Every sample takes part, so noise averages out; what is unknown of offset and envelope reaches the uncertainty of the
profile through the covariance. The evidence of a fit (Laplace's approximation; D. MacKay, Information Theory, Inference
and Learning Algorithms, chapter 28) weighs profiles and envelopes of different flexibility against each other.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.kernels import HARMONICS, fit_signal
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, end_weights, legendre, lengths_at, slopes_at
from fpcal_bayes.fringes.samples import Samples

#: Variance that a signal leaves of a mode's unit variance beyond which it says nothing of it.
_TOLD_NOTHING = 1.0 - 1e-6
#: Second and third harmonic relative to the fringe amplitude, as standard deviations.
_HARMONIC_SDS = (0.014, 0.014, 0.005, 0.005)
#: Standard deviations of the logarithm of the amplitude, and of the mean in amplitudes.
_AMPLITUDE_SD, _MEAN_SD = 1.0, 20.0


@dataclass(frozen=True)
class Nuisance:
    """How a signal may change beside its fringes: standard deviations of Legendre coefficients."""

    offset: tuple[float, ...]  # over time, relative to the fringe amplitude, from the first polynomial on
    gain: tuple[float, ...]  # of the logarithm of the amplitude over time, from the first on
    #: Of the same over the place on the sweep, from the first on; empty: the mirror stays aligned.
    fade: tuple[float, ...]
    fade_mean: tuple[float, ...] = ()  # expected values of the latter; empty: zero

    @property
    def counts(self) -> tuple[int, int, int]:
        """Coefficients of the offset, of the gain, of the fading."""
        return len(self.offset) + 1, len(self.gain) + 1, len(self.fade)


#: A mirror that stays aligned; and one that the fibre loses as it tilts.
_OFFSET, _GAIN = (0.2, 0.12, 0.03, 0.015), (0.1, 0.06, 0.02, 0.01)
CALM = Nuisance(offset=_OFFSET, gain=_GAIN, fade=())
LIVELY = Nuisance(offset=_OFFSET, gain=_GAIN, fade=(0.6, 0.2, 0.02, 0.01))


@dataclass(frozen=True)
class Fit:
    """A signal fitted."""

    profile: Floats  # coefficients in um, DEGREE or more
    covariance: Floats  # of these
    modes: Floats  # what the last unknowns, of standard normal priors, add to the profile, shape (degree, n_modes)
    unknowns: Floats  # all that was fitted, in the order of `normal_equations`
    unknowns_covariance: Floats  # of these
    prior: tuple[Floats, Floats]  # mean of the unknowns before the fit, and the inverse of their covariance
    nuisance: Nuisance  # what was allowed beside the fringes
    noise: float  # standard deviation of one reading that was presumed, in V
    evidence: float  # logarithm, up to a constant that fits of one trace share
    residual_squares: float  # sum over readings of the squared residuals of averages, times their count, in V^2
    freedom: float  # number of averages less the effective number of unknowns
    ends: tuple[float, float] = (-1.0, 1.0)  # places at which the mirror is when the joint starts and ends
    ends_variance: float = 0.0  # what not knowing them adds to the variance of the change, in um^2

    @property
    def change(self) -> tuple[float, float]:
        """L(end) - L(start) and its standard deviation, in um."""
        weights = end_weights(len(self.profile), self.ends)
        # Rounding may leave the variance of many polynomials a trace below zero.
        own = max(float(weights @ self.covariance @ weights), 0.0)
        return float(weights @ self.profile), float(np.sqrt(own + self.ends_variance))

    @property
    def amplitude(self) -> float:
        """Mean amplitude of the fringes in V."""
        return float(np.exp(self.unknowns[self.nuisance.counts[0]]))

    def told(self, s: Floats) -> tuple[Floats, Floats]:
        """Changes of L in um (n,) from the start by the signal alone, and a root of their covariance (n, n_modes)."""
        n = self.modes.shape[1]
        z, spread = self.unknowns[-n:], self.unknowns_covariance[-n:, -n:]
        variance, vectors = np.linalg.eigh(spread)
        # A normal prior of unit variance is taken off; a direction that the signal does not tell stays at its mean.
        left = 1.0 - np.clip(variance, 0.0, _TOLD_NOTHING)
        start, degree = np.array([-1.0]), len(self.profile)
        rows = (legendre(s, degree) - legendre(start, degree))[:, 1:]
        changes = rows @ (self.profile + self.modes @ (vectors @ ((vectors.T @ z) / left) - z))
        return changes, rows @ self.modes @ vectors * np.sqrt((1.0 - left) / left)

    def phase(self, s: Floats, phase_per_um: float) -> Floats:
        """Phase of the fringes at places `s` (n,), in rad."""
        at = sum(self.nuisance.counts) + 1 + HARMONICS
        return np.asarray(self.unknowns[at] + phase_per_um * lengths_at(self.profile, s))

    def signal(self, s: Floats, time: Floats, phase_per_um: float, spread: Floats | float = 0.0) -> Floats:
        """The fitted signal in V at places `s` and times `time` (n,), or averages over places of variance `spread`."""
        level, height = self.levels(s, time)
        return (
            level + height * damping(self.profile, s, spread, phase_per_um) * self.wave(self.phase(s, phase_per_um))[0]
        )

    def levels(self, s: Floats, time: Floats) -> tuple[Floats, Floats]:
        """Mean of the signal and height of its fringes in V, (n,) each."""
        n_offset, n_gain, n_fade = self.nuisance.counts
        u, at = self.unknowns, n_offset + n_gain
        over_time = legendre(time, max(n_offset, n_gain) - 1)
        height = np.exp(over_time[:, :n_gain] @ u[n_offset:at] + legendre(s, n_fade)[:, 1:] @ u[at : at + n_fade])
        return over_time[:, :n_offset] @ u[:n_offset] + u[at + n_fade] * height**2, height

    def wave(self, phase: Floats) -> tuple[Floats, Floats]:
        """Fringes of unit height with their harmonics at phases in rad, and their derivatives, (n,) each."""
        at = sum(self.nuisance.counts) + 1
        h1, h2, h3, h4 = self.unknowns[at : at + HARMONICS]
        turned = np.exp(1j * phase)
        second, third = (h1 - 1j * h2) * turned**2, (h3 - 1j * h4) * turned**3
        return (turned + second + third).real, -(turned + 2.0 * second + 3.0 * third).imag

    def misses(self, samples: Samples, places: Floats, phase_per_um: float) -> Floats:
        """Sums (m,) over readings of the squared residuals of averages, times their count, in V^2, at places (m, n)."""
        m = len(places)
        time, spread = np.tile(samples.time, m), np.tile(np.broadcast_to(samples.spread, len(samples)), m)
        fitted = self.signal(places.ravel(), time, phase_per_um, spread)
        return np.asarray((samples.signal - fitted.reshape(m, -1)) ** 2 @ samples.count)


def damping(profile: Floats, s: Floats, spread: Floats | float, phase_per_um: float) -> Floats:
    """What averages over places of a `spread` (n,) around `s` (n,) leave of the height of the fringes, (n,)."""
    if not np.any(spread):
        return np.ones(len(s))
    return np.asarray(np.exp(-0.5 * (phase_per_um * slopes_at(profile, s)) ** 2 * spread))


def fit_course(
    samples: Samples,
    profile: DisplacementProfile,
    start: Floats,
    phase_per_um: float,
    *,
    nuisance: Nuisance,
    noise: float,
    mirror_light: float = 0.0,
    max_steps: int = 40,
    warm: Fit | None = None,
    known: Fit | None = None,
    slope: Floats | None = None,
) -> Fit:
    """Fit a signal from the profile coefficients `start`, in um, as many as those of the prior `profile` or fewer.

    phase_per_um is 4 pi n / wavelength, noise the sd of one reading in V, mirror_light the light of the mirror alone
    over the square of the fringe amplitude in 1 / V. The fit starts from `warm`, a fit of the same samples, in place of
    `start`, has what other samples say, `known`, as its prior, and `slope` (n,), rad of phase for a unit of a last
    unknown.
    """
    mean, modes_um = profile.mean, profile.modes
    degree = len(mean)
    over_place, over_time = legendre(samples.s, max(degree, DEGREE)), legendre(samples.time)
    base = phase_per_um * (over_place[:, 1 : degree + 1] @ mean)
    modes = phase_per_um * (over_place[:, 1 : degree + 1] @ modes_um)
    if warm is None:
        first = start
        z = (np.pad(start, (0, degree - len(start))) - mean) @ modes_um / (modes_um**2).sum(axis=0)
        phase, amplitude = _phase_and_amplitude(samples, over_time, base + modes @ z)
        light = mirror_light if nuisance.fade else 0.0
        unknowns, prior_mean, prior_weight = _initial(samples, nuisance, amplitude, phase, z, light)
    else:
        n = sum(nuisance.counts) + 2 + HARMONICS + modes.shape[1]
        first, unknowns = warm.profile, warm.unknowns[:n].copy()
        prior_mean, prior_weight = warm.prior[0][:n], warm.prior[1][:n, :n]
    if known is not None:
        prior_mean, prior_weight = known.unknowns, np.linalg.inv(known.unknowns_covariance)
    if slope is not None:
        modes, unknowns = np.column_stack([modes, slope]), np.append(unknowns, 0.0)
        prior_mean, prior_weight = np.append(prior_mean, 0.0), block_diag(prior_weight, np.eye(1))
    data = (
        np.ascontiguousarray(over_time.T),
        np.ascontiguousarray(over_place.T),
        damping(first, samples.s, samples.spread, phase_per_um),
        np.array(nuisance.counts, dtype=np.int64),
        base,
        np.ascontiguousarray(modes.T),
        samples.signal,
        np.sqrt(samples.count) / noise,
    )
    weight = np.ascontiguousarray(prior_weight)
    cost, log_determinant, covariance = fit_signal(data, unknowns, prior_mean, weight, max_steps)
    off = prior_mean - unknowns
    residual_squares = noise**2 * max(cost - float(off @ prior_weight @ off), 0.0)
    freedom = len(samples) - len(unknowns) + float(np.sum(covariance * prior_weight))
    evidence = -0.5 * (cost + log_determinant - np.linalg.slogdet(prior_weight)[1])
    own = slice(len(unknowns) - modes.shape[1], len(unknowns) - modes.shape[1] + modes_um.shape[1])
    return Fit(
        profile=mean + modes_um @ unknowns[own],
        covariance=modes_um @ covariance[own, own] @ modes_um.T,
        modes=modes_um,
        unknowns=unknowns,
        unknowns_covariance=covariance,
        prior=(prior_mean, prior_weight),
        nuisance=nuisance,
        noise=noise,
        evidence=float(evidence),
        residual_squares=float(residual_squares),
        freedom=freedom,
    )


def _phase_and_amplitude(samples: Samples, over_time: Floats, f: Floats) -> tuple[float, float]:
    """Phase at the sweep's middle and mean amplitude of the fringes for a profile's phase `f` (n,)."""
    root = np.sqrt(samples.count)
    columns = np.column_stack([over_time[:, :3], np.cos(f), np.sin(f)]) * root[:, None]
    solution = np.linalg.lstsq(columns.T @ columns, columns.T @ (samples.signal * root), rcond=1e-12)[0]
    c, s = solution[3], solution[4]
    widest = float(np.ptp(samples.signal))
    return float(np.arctan2(-s, c)), float(np.clip(np.hypot(c, s), 0.05 * widest, 2.0 * widest))


def _initial(
    samples: Samples, nuisance: Nuisance, amplitude: float, phase: float, z: Floats, mirror_light: float
) -> tuple[Floats, Floats, Floats]:
    """Unknowns to start from, the means of their priors, and the inverse of the priors' covariance."""
    half = max(amplitude, 0.5 * float(np.ptp(samples.signal)))
    mean = float(samples.count @ samples.signal / samples.count.sum())
    rest = [*[0.0] * len(nuisance.gain), *(nuisance.fade_mean or [0.0] * len(nuisance.fade))]
    offset = [mean - mirror_light * half**2, *[0.0] * len(nuisance.offset)]
    none = [0.0] * HARMONICS
    unknowns = np.array([*offset, np.log(amplitude), *rest, mirror_light, *none, phase, *z])
    prior_mean = np.array([*offset, np.log(half), *rest, mirror_light, *none, 0.0, *np.zeros(len(z))])
    relative = [half * sd for sd in (_MEAN_SD, *nuisance.offset)]
    # Without a mirror that fades its light is part of the offset; a share of it held at zero says nothing.
    envelope = [_AMPLITUDE_SD, *nuisance.gain, *nuisance.fade, mirror_light or 1e-6]
    prior_sd = np.array([*relative, *envelope, *_HARMONIC_SDS, 100.0, *np.ones(len(z))])
    return unknowns, prior_mean, np.diag(prior_sd**-2)
