"""From samples to the profiles that explain them: search, fits, noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.fit import CALM, LIVELY, Fit, Nuisance, fit_course
from fpcal_bayes.fringes.profile import DisplacementProfile, legendre, lengths_at
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.fringes.search import distinct, find_profiles

#: Averages of a fringe at its fastest, for the choice among profiles and for the final fit, and the fewest of a sweep.
_CHOICE_BINS, _FINAL_BINS, _FEWEST_BINS = 10, 32, 160
#: Fits this much less likely (in logarithm) than the best are dropped.
_HOPELESS = 40.0
#: A mirror is expected to fade if a coefficient of log visibility passes this; the logarithm of the odds that it does.
_FADES, _UNLIKELY = 0.1, 5.0
_GRID = np.linspace(-1.0, 1.0, 129)


@dataclass(frozen=True)
class FringeSolution:
    """What explains a signal."""

    fits: tuple[Fit, ...]  # distinct profiles, the most likely first; at least one
    samples: Samples  # what the first was fitted to

    @property
    def best(self) -> Fit:
        """The most likely fit."""
        return self.fits[0]


def solve(
    samples: Samples,
    profile: DisplacementProfile,
    phase_per_um: float,
    noise: float | None,
    mirror_light: float = 0.0,
    fading: Nuisance = LIVELY,
) -> FringeSolution | None:
    """Profiles that explain a signal, or None; noise: sd of a reading in V; fading: what else the signal may do."""
    found = find_profiles(samples, profile, phase_per_um)
    if len(found) == 0:
        return None
    sd = noise if noise else 0.005 * float(np.ptp(samples.signal))
    chosen = found
    if len(found) > 1:
        used = samples.binned(bins(found, phase_per_um, _CHOICE_BINS))
        first = _distinct(
            [fit_course(used, profile, c, phase_per_um, nuisance=CALM, noise=sd, max_steps=20) for c in found]
        )
        # An envelope that CALM cannot follow spoils all fits alike: the others get their chance with fading.
        least = first[0].evidence - 0.5 * abs(first[0].evidence) - _HOPELESS
        chosen = np.array([fit.profile for fit in first[:3] if fit.evidence > least])
    used = samples.binned(bins(chosen, phase_per_um, _FINAL_BINS))

    def fit(start: Floats, nuisance: Nuisance) -> Fit:
        return fit_course(
            used, profile, start, phase_per_um, nuisance=nuisance, noise=sd, mirror_light=mirror_light, max_steps=30
        )

    # Where the optics say that the mirror fades, a mirror that does not needs better grounds than a short sweep has.
    doubt = _UNLIKELY if np.abs(fading.fade_mean or 0.0).max() > _FADES else 0.0
    fits = [
        max((fit(c, fading), fit(c, CALM)), key=lambda f: f.evidence - doubt * (f.nuisance is CALM)) for c in chosen
    ]
    solution = FringeSolution(_distinct(fits), used)
    own = noise_of(solution.best, sd)
    if abs(np.log(own / sd)) > 0.2:
        solution = with_noise(solution, profile, phase_per_um, own, mirror_light)
    least = solution.best.evidence - _HOPELESS
    return FringeSolution(tuple(fit for fit in solution.fits if fit.evidence > least), used)


def with_noise(
    solution: FringeSolution, profile: DisplacementProfile, phase_per_um: float, noise: float, mirror_light: float = 0.0
) -> FringeSolution:
    """The same profiles fitted anew with the standard deviation `noise` (V) of one reading."""
    samples = solution.samples
    again = partial(fit_course, samples, profile, phase_per_um=phase_per_um, noise=noise, mirror_light=mirror_light)
    fits = [again(fit.profile, nuisance=fit.nuisance, warm=fit) for fit in solution.fits]
    return FringeSolution(_distinct(fits), samples)


def rescaled(solution: FringeSolution, noise: float) -> FringeSolution:
    """The same fits with their covariances for a noise (V) that is nearly what was presumed."""
    names = ("covariance", "unknowns_covariance", "ends_variance")
    fits = [
        replace(fit, noise=noise, **{name: (noise / fit.noise) ** 2 * getattr(fit, name) for name in names})
        for fit in solution.fits
    ]
    return replace(solution, fits=tuple(fits))


def path_fringes(profile: Floats, phase_per_um: float, grid: Floats = _GRID) -> float:
    """Fringes that pass along a profile (DEGREE,), those that pass back included."""
    return float(np.abs(np.diff(lengths_at(profile, grid))).sum() * phase_per_um / (2.0 * np.pi))


def noise_of(fit: Fit, before: float) -> float:
    """Noise of one reading by the residuals, held to what was presumed as far as they are few."""
    weight = 4.0
    return float(np.sqrt((weight * before**2 + fit.residual_squares) / (weight + max(fit.freedom, 0.0))))


def bins(profiles: Floats, phase_per_um: float, a_fringe: int) -> int:
    """Averages of a sweep that give a fringe `a_fringe` of them where profiles (n, degree) are fastest."""
    slopes = np.abs(np.diff(legendre(_GRID)[:, 1:] @ profiles.T, axis=0)).max() / (_GRID[1] - _GRID[0])
    return max(_FEWEST_BINS, int(np.ceil(2.0 * slopes * phase_per_um / (2.0 * np.pi) * a_fringe)))


def _distinct(fits: Sequence[Fit]) -> tuple[Fit, ...]:
    """Fits by falling evidence, each profile once."""
    ranked = sorted(fits, key=lambda each: -each.evidence)
    near = np.array([5.0 * np.sqrt(np.diag(fit.covariance)).max() + 1e-3 for fit in ranked])
    return tuple(ranked[i] for i in distinct(np.array([fit.profile for fit in ranked]), near))
