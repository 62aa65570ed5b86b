"""Traces of a mirror that does not follow its joint: it sets out late, lags, or runs unevenly.

The joint column then tells when, not where. What the mirror did is read off the fringes: a late start and a lag have
one number each, an uneven course is a profile of more polynomials. The evidence chooses among them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.fit import Fit, Nuisance, fit_course
from fpcal_bayes.fringes.misfit import PhaseErrors
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, legendre, lengths_at, loosened
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.fringes.search import find_profiles
from fpcal_bayes.fringes.solve import FringeSolution, bins, noise_of, path_fringes

#: Fringes that a mirror may have missed at the start, steps of a fringe tried and the best of them looked at closely;
#: lags tried, in half traces.
_MOST_LATE, _LATE_STEP, _FINER, _PEAKS, _ROUNDS = 3.2, 1.0 / 6.0, 8, 4, 6
_LAGS = np.geomspace(1e-3, 0.3, 14)
#: Polynomials of an uneven course, with the size in um of the first; sizes of the others fall as one over their number.
_COURSES = ((10, 0.15), (20, 0.3), (40, 1.0))
#: Length in fringes over which the phase is averaged to begin with, and averages of a fringe.
_AVERAGED, _BINS = 0.4, 16
#: Below this probability noise alone does not explain what a fit leaves.
UNLIKELY = 1e-4

#: Moves samples to where the mirror is, for one number.
_Warp = Callable[[Samples, float], Samples]
_Fitter = Callable[[Samples, Fit | None, DisplacementProfile, Floats], Fit]


@dataclass(frozen=True)
class Followed:
    """What a mirror did that left its joint's course."""

    solution: FringeSolution
    phase_per_um: float
    #: set_out, lag: Place at which the mirror set out, and how long it lags, as a share of half the trace.
    set_out: float = -1.0
    lag: float = 0.0
    uneven: bool = False  # whether the course has polynomials that no joint makes

    @cached_property
    def errors(self) -> PhaseErrors:
        """What the best fit leaves."""
        return PhaseErrors.of(self.solution.best, self.solution.samples, self.phase_per_um)

    @property
    def astray(self) -> bool:
        """Whether the mirror leaves the joint's course."""
        return self.uneven or self.set_out > -1.0 or self.lag > 0.0

    def missed(self) -> tuple[float, float]:
        """Change of L in um that the mirror missed at the start, and that it still lacks at the end."""
        ends, profile = self.solution.best.ends, self.solution.best.profile
        (first, last), (start, end) = (lengths_at(profile, np.array(at)) for at in (ends, (-1.0, 1.0)))
        return float(abs(first - start)), float(abs(end - last))


def follow(
    samples: Samples,
    profile: DisplacementProfile,
    phase_per_um: float,
    smooth: FringeSolution | None,
    nuisance: Nuisance,
    noise: float,
    mirror_light: float = 0.0,
) -> Followed | None:
    """The most likely course of a mirror, the smooth one among others.

    smooth: what was found on the joint's course, if anything.
    nuisance: what the signal may do beside its fringes.
    noise: standard deviation of one reading in V to begin with.
    Returns none where nothing resembles a fringe.
    """
    start = smooth.best.profile if smooth else _searched(samples, profile, phase_per_um)
    if start is None:
        return None
    used = _chunked(samples, bins(start[None], phase_per_um, _BINS))

    def fit(moved: Samples, warm: Fit | None, prior: DisplacementProfile, begin: Floats) -> Fit:
        return fit_course(
            moved,
            prior,
            begin,
            phase_per_um,
            nuisance=nuisance,
            noise=noise,
            mirror_light=mirror_light,
            max_steps=20,
            warm=warm,
        )

    tries = [Followed(FringeSolution((fit(used, None, profile, start),), used), phase_per_um)]
    fringes = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(lengths_at(start, _PLACES))))]) * phase_per_um / 2 / np.pi
    places = np.interp(np.arange(_LATE_STEP, min(_MOST_LATE, 0.6 * fringes[-1]), _LATE_STEP), fringes, _PLACES)
    smoothest = tries[0].solution.best
    if len(places) > 2:
        found, at = _scanned(used, _late, places, smoothest, profile, phase_per_um, fit)
        tries.append(Followed(FringeSolution((found,), _late(used, at)), phase_per_um, set_out=at))
    found, at = _scanned(used, _lagging, _LAGS, smoothest, profile, phase_per_um, fit)
    tries.append(Followed(FringeSolution((found,), _lagging(used, at)), phase_per_um, lag=at))
    tries += _uneven(tries[0], profile, fit)
    best = max(tries, key=lambda each: each.solution.best.evidence)
    if best.set_out > -1.0 or best.lag > 0.0:
        tries += _uneven(best, profile, fit) if best.errors.probability < UNLIKELY else []
    # The flexible fits tell the noise, and by that noise all are weighed.
    best = max(tries, key=lambda each: each.solution.best.evidence)
    noise = noise_of(best.solution.best, noise)
    weighed = []
    for each in tries:
        old, moved = each.solution.best, each.solution.samples
        prior = profile if len(old.profile) == DEGREE else _loose(profile, len(old.profile))
        new = replace(fit(moved, old, prior, old.profile), ends=old.ends)
        new = replace(new, ends_variance=old.ends_variance * (noise / old.noise) ** 2)
        weighed.append(replace(each, solution=FringeSolution((new,), moved)))
    return max(weighed, key=lambda each: each.solution.best.evidence)


_PLACES = np.linspace(-1.0, 1.0, 1025)


def _searched(samples: Samples, profile: DisplacementProfile, phase_per_um: float) -> Floats | None:
    found = find_profiles(samples, loosened(profile, DEGREE, 0.3), phase_per_um, 1)
    return found[0] if len(found) else None


def _chunked(samples: Samples, n: int) -> Samples:
    """Averages over equal times, so that all courses are held against the same numbers."""
    size = max(1, len(samples) // n)
    first = np.arange(0, len(samples), size)
    count = np.add.reduceat(samples.count, first)
    parts = (samples.s, samples.time, samples.signal)
    s, time, signal = (np.add.reduceat(samples.count * part, first) / count for part in parts)
    return Samples(s, time, signal, count)


def _late(samples: Samples, place: float) -> Samples:
    return replace(samples, s=np.maximum(samples.s, place))


def _lagging(samples: Samples, lag: float) -> Samples:
    share = np.exp(-2.0 / (len(samples) - 1) / lag)
    first = samples.s[0]
    return replace(samples, s=first + lfilter([1.0 - share], [1.0, -share], samples.s - first))


def _scanned(
    used: Samples,
    warp: _Warp,
    grid: Floats,
    smooth: Fit,
    profile: DisplacementProfile,
    phase_per_um: float,
    fit: _Fitter,
) -> tuple[Fit, float]:
    """The best fit of a warped trace and its number; how little a trace tells of it goes to the change's variance."""

    def at(value: float, warm: Fit) -> Fit:
        moved = warp(used, value)
        return replace(fit(moved, warm, profile, warm.profile), ends=(float(moved.s[0]), float(moved.s[-1])))

    fits = [smooth]
    for value in grid:
        fits.append(at(float(value), fits[-1]))
    fits = fits[1:]
    screen = max(fits, key=lambda each: each.evidence)
    told = used
    if warp is _late:
        # A phase and its mirror image at the nearest extreme make the same signal: the first samples part them.
        grid = np.linspace(grid[0], grid[-1], _FINER * len(grid))
        early = used.s <= grid[-1]
        told = Samples(used.s[early], used.time[early], used.signal[early], used.count[early])

    def costs_of(values: Floats, held: Fit) -> Floats:
        return np.array([held.misses(warp(told, float(value)), phase_per_um) for value in values])

    costs = costs_of(grid, screen) if warp is _late else -np.array([each.evidence for each in fits])
    beside = np.pad(costs, 1, constant_values=np.inf)
    lows = np.flatnonzero((costs <= beside[:-2]) & (costs <= beside[2:]))
    refined = []
    for i in lows[np.argsort(costs[lows])][:_PEAKS]:
        low, high = grid[max(i - 1, 0)], grid[min(i + 1, len(grid) - 1)]
        width = 0.25 * (high - low)
        found = minimize_scalar(
            lambda value: -at(value, screen).evidence,
            bounds=(low - (i == 0) * 0.5 * width, high),
            method="bounded",
            options={"xatol": 0.01 * width},
        )
        refined.append((at(found.x, screen), float(found.x), width))
    best, value, width = max(refined, key=lambda each: each[0].evidence)
    # Near an extreme the number's posterior is flat or has two tops, so it is laid out and not taken for normal.
    for _ in range(_ROUNDS):
        near = value + width * np.linspace(-1.0, 1.0, 13)
        laid = [at(float(each), best) for each in near if each > 0.0 or warp is _late]
        share = np.exp([each.evidence - max(other.evidence for other in laid) for each in laid])
        best, value = laid[int(np.argmax(share))], float(near[-len(laid) :][int(np.argmax(share))])
        if (share > 0.05).sum() >= 4 and share[[0, -1]].max() < 0.05:
            break
        width *= 2.0 if share[[0, -1]].max() >= 0.05 else 0.3
    change = np.array([each.change[0] for each in laid])
    return replace(best, ends_variance=float(share @ (change - best.change[0]) ** 2 / share.sum())), value


def _loose(profile: DisplacementProfile, degree: int) -> DisplacementProfile:
    return loosened(profile, degree, dict(_COURSES)[degree])


def _uneven(base: Followed, profile: DisplacementProfile, fit: _Fitter) -> list[Followed]:
    """Fits of courses with more and more polynomials, along the places of `base`."""
    old, moved = base.solution.best, base.solution.samples
    begin = _demodulated(old, moved, base.phase_per_um)
    tried = []
    for degree, _ in _COURSES:
        if len(moved) > 6 * degree:
            prior = _loose(profile, degree)
            fits = [fit(moved, None, prior, first) for first in (old.profile, begin[:degree])]
            best = max(fits, key=lambda each: each.evidence)
            best = replace(best, ends=old.ends, ends_variance=old.ends_variance)
            tried.append(replace(base, solution=FringeSolution((best,), moved), uneven=True))
    return tried


def _demodulated(fit: Fit, samples: Samples, phase_per_um: float) -> Floats:
    """Coefficients of a profile by the phase of the fringes against that of a fit."""
    degree = _COURSES[-1][0]
    basis = legendre(samples.s, degree)
    level = samples.signal - basis[:, :3] @ np.linalg.lstsq(basis[:, :3], samples.signal)[0]
    width = _AVERAGED * len(samples) / max(path_fringes(fit.profile, phase_per_um), 1.0)
    turned = gaussian_filter1d(level * np.exp(-1j * fit.phase(samples.s, phase_per_um)), width)
    phase = np.unwrap(np.angle(turned)) / phase_per_um
    # A ridge keeps high polynomials from following what the averages cannot.
    ridge = 1e-3 * len(samples) * np.diag(np.arange(degree + 1.0) ** 2 / degree**2)
    found = np.linalg.solve(basis.T @ basis + ridge, basis.T @ phase)[1:]
    found[: len(fit.profile)] += fit.profile[:degree]
    return np.asarray(found)
