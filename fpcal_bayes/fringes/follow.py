"""Traces of a mirror that does not follow its joint: it sets out late, lags, or runs unevenly.

The joint column then tells when, not where. What the mirror did is read off the fringes: a late start and a lag have
one number each, an uneven course is a profile of more polynomials. The evidence chooses among them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_banded
from scipy.ndimage import gaussian_filter1d

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.fit import Fit, Nuisance, fit_course
from fpcal_bayes.fringes.misfit import PhaseErrors
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, legendre, lengths_at, loosened
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.fringes.search import find_profiles
from fpcal_bayes.fringes.solve import FringeSolution, bins, noise_of, path_fringes

#: Fringes that a mirror may have missed at the start, steps of a fringe tried and the best of them looked at closely;
#: lags tried, in half traces.
_MOST_LATE, _LATE_STEP, _PEAKS, _ROUNDS, _CLOSE = 3.2, 1.0 / 40.0, 2, 6, 200.0
_LAGS = np.geomspace(2e-3, 0.2, 8)
#: Polynomials of an uneven course, with the size in um of the first; sizes of the others fall as one over their number.
_COURSES = ((10, 0.15), (20, 0.3), (30, 0.6), (40, 1.0))
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
    places = np.interp(np.arange(0.0, min(_MOST_LATE, 0.6 * fringes[-1]), _LATE_STEP), fringes, _PLACES)
    if len(places) > 2:
        found, at = _scanned(samples, _late, places, tries[0], profile, fit)
        tries.append(Followed(found, phase_per_um, set_out=at))
    found, at = _scanned(samples, _lagging, _LAGS, tries[0], profile, fit)
    tries.append(Followed(found, phase_per_um, lag=at))
    best = max(tries, key=lambda each: each.solution.best.evidence)
    if best.errors.probability < UNLIKELY:
        tries += _uneven(tries[0], profile, fit) + (_uneven(best, profile, fit) if best.set_out > -1.0 else [])
    # The flexible fits tell the noise, and by that noise all are weighed.
    best = max(tries, key=lambda each: each.solution.best.evidence)
    noise = noise_of(best.solution.best, noise)
    weighed = []
    ranked = sorted(tries, key=lambda each: -each.solution.best.evidence)[:3]
    for each in {id(each): each for each in (tries[0], *ranked)}.values():
        old, moved = each.solution.best, each.solution.samples
        prior = profile if len(old.profile) == DEGREE else _loose(profile, len(old.profile))
        new = replace(fit(moved, old, prior, old.profile), ends=old.ends)
        new = replace(new, ends_variance=old.ends_variance * (noise / old.noise) ** 2)
        weighed.append(replace(each, solution=FringeSolution((new,), moved)))
    best = max(weighed, key=lambda each: each.solution.best.evidence)
    # Courses that do about as well may end elsewhere.
    chosen, fits = best.solution.best, [each.solution.best for each in weighed]
    share = np.exp(np.array([each.evidence for each in fits]) - chosen.evidence)
    apart = np.array([each.change[0] - chosen.change[0] for each in fits])
    wide = replace(chosen, ends_variance=chosen.ends_variance + float(share @ apart**2 / share.sum()))
    return replace(best, solution=replace(best.solution, fits=(wide,)))


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
    # s' = share s'(before) + (1 - share) s, a bidiagonal system.
    bands = np.vstack([np.ones(len(samples)), np.full(len(samples), -share)])
    lagged = solve_banded((1, 0), bands, (1.0 - share) * (samples.s - first))
    return replace(samples, s=first + lagged)


def _scanned(
    whole: Samples,
    warp: _Warp,
    grid: Floats,
    smooth: Followed,
    profile: DisplacementProfile,
    fit: _Fitter,
) -> tuple[FringeSolution, float]:
    """The best fit of a warped trace and its number; how little a trace tells of it goes to the change's variance."""
    used, first = smooth.solution.samples, smooth.solution.best

    def at(value: float, warm: Fit) -> FringeSolution:
        moved = warp(whole, value)
        # A late mirror reaches the end with its joint; one that lags does not.
        ends = (max(-1.0, value), 1.0) if warp is _late else (float(moved.s[0]), float(moved.s[-1]))
        moved = _chunked(moved, len(used))
        return FringeSolution((replace(fit(moved, warm, profile, warm.profile), ends=ends),), moved)

    least = -np.inf if warp is _late else 0.0
    if warp is _late:
        # Only the first samples tell a late start, and in a fit of the others they take no part.
        early = used.part(used.s <= grid[-1])
        held = fit(used.part(used.s > grid[-1]), first, profile, first.profile)
        for _ in range(2):
            costs = np.array([held.misses(warp(early, float(v)), smooth.phase_per_um) for v in grid]) / held.noise**2
            held = at(float(grid[np.argmin(costs)]), held).best
    else:
        fits = [at(float(grid[0]), first).best]
        for value in grid[1:]:
            fits.append(at(float(value), fits[-1]).best)
        costs = -2.0 * np.array([each.evidence for each in fits])
        held = fits[int(np.argmin(costs))]
    # A phase and its mirror image at the nearest extreme make nearly the same signal, and each is looked at closely.
    beside = np.pad(costs, 1, constant_values=np.inf)
    lows = np.flatnonzero((costs <= beside[:-2]) & (costs <= beside[2:]))
    # Between two steps of the grid a low may lie deeper, by less than it rises to its neighbours.
    depth = costs[lows] - np.minimum(beside[:-2], beside[2:])[lows]
    likely = costs[lows] + np.where(np.isfinite(depth), depth, 0.0) < costs.min() + _CLOSE
    laid: list[tuple[FringeSolution, float, float]] = []
    for i in lows[likely][np.argsort(costs[lows[likely]])][:_PEAKS]:
        value = float(grid[i])
        laid += _laid(at, held, value, least, 0.5 * float(grid[min(i + 1, len(grid) - 1)] - grid[max(i - 1, 0)]))
    best, value, width = max(laid, key=lambda each: each[0].best.evidence)
    if warp is _late:
        phase, further = best.best.phase(np.array([value, value + 1e-6]), smooth.phase_per_um)
        image = value + 2e-6 * (np.round(phase / np.pi) * np.pi - phase) / (further - phase)
        laid += _laid(at, best.best, float(image), least, 4.0 * width)
        best, value, _ = max(laid, key=lambda each: each[0].best.evidence)
    share = np.array([width * np.exp(each.best.evidence - best.best.evidence) for each, _, width in laid])
    change = np.array([each.best.change[0] for each, *_ in laid]) - best.best.change[0]
    known = replace(best.best, ends_variance=float(share @ change**2 / share.sum()))
    return replace(best, fits=(known,)), value


def _laid(
    at: Callable[[float, Fit], FringeSolution], held: Fit, value: float, least: float, width: float
) -> list[tuple[FringeSolution, float, float]]:
    """Fits around a number, which need not be normal, with the numbers and the width that each stands for."""
    for _ in range(_ROUNDS):
        near = value + width * np.linspace(-1.0, 1.0, 9)
        near = near[near > least]
        found = [at(float(each), held) for each in near]
        evidence = np.array([each.best.evidence for each in found])
        share = np.exp(evidence - evidence.max())
        held, value = found[int(np.argmax(share))].best, float(near[int(np.argmax(share))])
        outside = share[[0, -1]].max() >= 0.05
        if (share > 0.05).sum() >= 3 and not outside:
            break
        width *= 1.5 if outside else 0.35
    return [(each, float(v), 0.25 * width) for each, v in zip(found, near, strict=True)]


def _loose(profile: DisplacementProfile, degree: int) -> DisplacementProfile:
    return loosened(profile, degree, dict(_COURSES)[degree])


def _uneven(base: Followed, profile: DisplacementProfile, fit: _Fitter) -> list[Followed]:
    """Fits of courses with more and more polynomials, along the places of `base`."""
    old, moved = base.solution.best, base.solution.samples
    begin = _demodulated(old, moved, base.phase_per_um)
    tried = []
    for degree, _ in _COURSES:
        if len(moved) > 5 * degree:
            prior = _loose(profile, degree)
            best = replace(fit(moved, None, prior, begin[:degree]), ends=old.ends, ends_variance=old.ends_variance)
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
