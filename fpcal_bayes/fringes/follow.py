"""Traces of a mirror that does not follow its joint: it sets out late, lags, or runs unevenly.

The joint column then tells when, not where. What the mirror did is read off the fringes: a late start and a lag have
one number each, an uneven course is a profile of more polynomials. The evidence chooses among them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.linalg import solve_banded
from scipy.ndimage import gaussian_filter1d

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.count import ALONE
from fpcal_bayes.fringes.fit import Fit, Nuisance, fit_course
from fpcal_bayes.fringes.misfit import PhaseErrors
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, legendre, lengths_at, loosened, slopes_at
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.fringes.search import find_profiles
from fpcal_bayes.fringes.solve import FringeSolution, bins, noise_of, path_fringes

#: Fringes that a mirror may have missed at the start, steps of a fringe tried and the best of them looked at closely;
#: lags tried, in half traces.
_MOST_LATE, _LATE_STEP, _PEAKS, _ROUNDS, _CLOSE = 3.2, 1.0 / 40.0, 2, 6, 200.0
_LAGS = np.geomspace(2e-3, 0.2, 8)
#: Polynomials of an uneven course, with its size in um to begin with; fits in which the size settles.
_SIZINGS = 2
_COURSES = ((15, 0.1), (30, 0.3), (45, 0.6), (60, 0.6))
#: Odds of a lag where nothing speaks for it.
_LAG_ODDS = 0.01
#: Phase in rad within which a late start may be told by few samples.
_HIDDEN = 3.0 * np.pi
#: Samples that tell about where a trace's start ends, and averages of that start.
_THINNED = 1000
#: Places at which a hop of the phase is sought to begin with.
_HOPS = 48
#: Share of a trace below which its first samples are fitted beside what the others say.
_FEW = 0.3
#: Share of the evidence by which one uneven course is told from another.
_CLEARLY = 0.5
#: Length in fringes over which the phase is averaged to begin with, and averages of a fringe.
_AVERAGED, _BINS = 0.4, 16
#: Below these probabilities noise alone does not explain what a fit leaves, and may not.
UNLIKELY, DOUBTED = 1e-4, 0.02

#: Fits samples from another fit, on the joint's course unless told otherwise.
_Fitter = Callable[..., Fit]


@dataclass(frozen=True)
class Followed:
    """What a mirror did that left its joint's course."""

    solution: FringeSolution
    phase_per_um: float
    set_out: float = -1.0  # place at which the mirror set out
    stop: float = 1.0  # place at which it stopped
    lag: float = 0.0  # how long it lags, as a share of half the trace
    size: float = 0.0  # of a course that has polynomials that no joint makes, in um
    hop: float = 0.0  # of the phase, in rad, that explains the trace as well as such a course
    prior: float = 0.0  # logarithm of the odds of such a mirror, and of the share of late starts that do as well
    #: How much likelier a late start, and an early stop, makes the trace, NaN where that is not known; the same times
    #: the square of what is missed in um^2, as far as the fit lacks it. Shape (2, 2).
    told: Floats = field(default_factory=lambda: np.full((2, 2), np.nan), repr=False)

    @cached_property
    def errors(self) -> PhaseErrors:
        """What the best fit leaves."""
        return PhaseErrors.of(self.solution.best, self.solution.samples, self.phase_per_um)

    @property
    def uneven(self) -> bool:
        """Whether the course has polynomials that no joint makes."""
        return self.size > 0.0

    @property
    def evidence(self) -> float:
        """Logarithm of how likely the best fit makes the trace, with the odds of such a mirror."""
        return self.solution.best.evidence + self.prior

    @property
    def short(self) -> bool:
        """Whether the mirror sets out late or stops early."""
        return self.set_out > -1.0 or self.stop < 1.0

    @property
    def astray(self) -> bool:
        """Whether the mirror leaves the joint's course."""
        return self.uneven or self.short or self.lag > 0.0

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
    errs: bool = False,
    odds: Sequence[float] = (ALONE, ALONE),
) -> Followed | None:
    """The likeliest course of a mirror, or None: `noise` of a reading in V, `errs`: it is known to leave `smooth`.

    odds: of a late start and of an early stop.
    """
    found = [smooth.best.profile] if smooth else find_profiles(samples, loosened(profile, DEGREE, 0.3), phase_per_um, 1)
    if not len(found):
        return None
    start = found[0]
    size = max(1, len(samples) // bins(start[None], phase_per_um, _BINS))
    used = _chunked(samples, size)

    def fit(
        moved: Samples, warm: Fit | None, prior: DisplacementProfile = profile, begin: Floats = start, **more: Any
    ) -> Fit:
        given = more | {"nuisance": nuisance, "noise": noise, "mirror_light": mirror_light, "max_steps": 20}
        return fit_course(moved, prior, begin, phase_per_um, warm=warm, **given)

    tries = [Followed(FringeSolution((fit(used, None),), used), phase_per_um)]
    fringes = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(lengths_at(start, _PLACES))))]) * phase_per_um / 2 / np.pi
    missed = np.arange(0.0, min(_MOST_LATE, 0.6 * fringes[-1]), _LATE_STEP)
    starts, stops = (np.interp(passed, fringes, _PLACES) for passed in (missed, fringes[-1] - missed))
    if len(missed) > 2:
        tries.append(_short(samples, size, starts, tries[0], fit, odds[0]))
    tries.append(_lagged(samples, size, tries[0], fit))
    best = max(tries, key=lambda each: each.evidence)
    if len(missed) > 2 and (not best.short or best.errors.probability < DOUBTED):
        tries.append(_short(samples, size, stops, tries[0], fit, odds[1]))
        best = max(tries, key=lambda each: each.evidence)
    if errs or best.errors.probability < UNLIKELY:
        tries += _uneven(tries[0], profile, fit) + (_uneven(best, profile, fit) if best.short else [])
    best = max(tries, key=lambda each: each.evidence)
    if best.uneven and len(missed) > 2 and (best.short or not errs):
        # Where it set out or stopped was sought along the joint's course, and is sought along its own.
        held = best.solution.best
        own = partial(fit, prior=loosened(profile, len(held.profile), best.size), begin=held.profile)
        along = replace(best, solution=FringeSolution((held,), used))
        for grid in (starts,) if best.set_out > -1.0 else (stops,) if best.stop < 1.0 else (starts, stops):
            tries.append(replace(_short(samples, size, grid, along, own, odds[grid is stops]), size=best.size))
    # The flexible fits tell the noise, and by that noise all are weighed.
    best = max(tries, key=lambda each: each.evidence)
    noise = noise_of(best.solution.best, noise)
    weighed = []
    ranked = sorted(tries, key=lambda each: -each.evidence)[:3]
    for each in {id(each): each for each in (tries[0], *ranked)}.values():
        old, moved = each.solution.best, each.solution.samples
        prior = loosened(profile, len(old.profile), each.size) if each.uneven else profile
        variance = old.ends_variance * (noise / old.noise) ** 2
        new = replace(fit(moved, old, prior, old.profile), ends=old.ends, ends_variance=variance)
        weighed.append(replace(each, solution=FringeSolution((new,), moved)))
    best, told = max(weighed, key=lambda each: each.evidence), np.full((2, 2), np.nan)
    alike = [each for each in weighed if each.uneven == best.uneven]
    for i, ends in enumerate(np.array([(each.set_out > -1.0, each.stop < 1.0) for each in alike]).T):
        if ends.any() and not ends.all():
            evidence = np.array([each.evidence for each in alike]) - np.log(odds[i]) * ends
            told[i] = np.exp(min(evidence[ends].max() - evidence[~ends].max(), 300.0)), 0.0
    if best.uneven:
        best = _hopped(best, samples, size, tries[0], fit)
    # Courses that do about as well may end elsewhere. None of those that are uneven is as rough as the stage's own, so
    # that they are told apart less clearly than their evidence says.
    chosen = best.solution.best
    share = np.exp((_CLEARLY if best.uneven else 1.0) * np.array([each.evidence - best.evidence for each in weighed]))
    apart = np.array([each.solution.best.change[0] - chosen.change[0] for each in weighed])
    spread = apart**2 + np.array([each.solution.best.ends_variance for each in weighed])
    wide = replace(chosen, ends_variance=float(share @ spread / share.sum()))
    return replace(best, solution=replace(best.solution, fits=(wide,)), told=told)


def hidden(fit: Fit, samples: Samples, phase_per_um: float, end: float = -1.0) -> tuple[float, float]:
    """How much likelier than none a late start makes a trace, over all delays, and that times their squares in um^2.

    The mirror stands wherever the mean of its first n samples says, provided that the joint is there after n of them:
    around an extreme of the fringe few samples tell. end: 1 for an early stop, read backwards.
    """
    samples = samples if end < 0.0 else samples.part(slice(None, None, -1))
    first, inside = fit.phase(np.array([end, end * (1.0 - 1e-6)]), phase_per_um).tolist()
    ahead = float(np.sign(inside - first))
    first *= ahead
    step = 1 + len(samples) // _THINNED
    beyond = np.append(ahead * fit.phase(samples.s[::step], phase_per_um) > first + _HIDDEN, True)
    few = samples.part(slice(step * int(np.argmax(beyond)) + 2))
    few = _chunked(few, 1 + len(few) // _THINNED)
    level, height = fit.levels(few.s, few.time)
    phase = fit.phase(few.s, phase_per_um)
    wave, signal = fit.wave(phase)[0], (few.signal - level) / height
    phase = ahead * phase
    weight = few.count * (height / fit.noise) ** 2
    total, mean = np.cumsum(weight), np.cumsum(weight * signal) / np.cumsum(weight)
    # Between samples and extremes the fringe rises or falls: where it comes nearest to the mean it stood.
    edges = np.sort(np.concatenate([phase, np.pi * np.arange(np.ceil(phase[0] / np.pi), phase[-1] / np.pi)]))
    n = np.clip(np.searchsorted(np.maximum.accumulate(phase), edges[:-1], side="right") - 1, 0, len(phase) - 1)
    height = fit.wave(ahead * edges)[0]
    low, high = np.sort([height[:-1], height[1:]], axis=0)
    still, half = np.clip(mean[n], low, high), np.floor((edges[:-1] + edges[1:]) / 2.0 / np.pi)
    image = np.pi * half + np.arccos(np.clip(np.where(half % 2.0, -still, still), -1.0, 1.0))
    shift = (np.clip(image, edges[:-1], edges[1:]) - first) / phase_per_um
    moves = np.cumsum(weight * ((signal - wave) ** 2 - signal**2))
    gain = 0.5 * (moves[n] + total[n] * (2.0 * mean[n] - still) * still)
    # The mean tells the place so well, but at an extreme no better than these ends.
    width = np.minimum(np.diff(edges), np.sqrt(2.0 * np.pi / np.maximum(total[n] * (1.0 - still**2), 1e-9)))
    share = np.exp(np.minimum(gain, 300.0)) * width / (2.0 * np.pi * _MOST_LATE)
    return float(share.sum()), float(share @ shift**2)


_PLACES = np.linspace(-1.0, 1.0, 1025)


def _chunked(samples: Samples, size: int) -> Samples:
    """Averages of `size` samples, so that all courses are held against the same numbers."""
    starts = np.arange(0, len(samples), size)
    return samples.summed(lambda values: [np.add.reduceat(each, starts) for each in values])


def _lagging(samples: Samples, lag: float) -> Samples:
    share = np.exp(-2.0 / (len(samples) - 1) / lag)
    first = samples.s[0]
    # s' = share s'(before) + (1 - share) s, a bidiagonal system.
    bands = np.vstack([np.ones(len(samples)), np.full(len(samples), -share)])
    return replace(samples, s=first + solve_banded((1, 0), bands, (1.0 - share) * (samples.s - first)))


def _short(whole: Samples, size: int, grid: Floats, smooth: Followed, fit: _Fitter, odds: float) -> Followed:
    """A mirror that sets out late, or stops early where the places tried run back; what is told poorly widens it."""
    used, first, per_um = smooth.solution.samples, smooth.solution.best, smooth.phase_per_um
    stops = bool(grid[-1] < grid[0])
    limit, order = (np.minimum, 1) if stops else (np.maximum, -1)
    # Only the first samples tell a late start, and in a fit of the others they take no part.
    is_early = np.logical_or.accumulate(((used.s >= grid[-1]) if stops else (used.s <= grid[-1]))[::order])[::order]
    early, held = used.part(is_early), fit(used.part(~is_early), first)
    known, some = None, whole
    # What many others say of the signal is normal, and need not be worked out again.
    if len(early) < _FEW * len(used):
        known, some = held, whole.part(np.repeat(is_early, size)[: len(whole)])

    def at(value: float, warm: Fit, known: Fit | None = known, some: Samples = some) -> FringeSolution:
        moved = _chunked(replace(some, s=limit(some.s, value)), size)
        ends = (-1.0, min(value, 1.0)) if stops else (max(-1.0, value), 1.0)
        # What others say is no prior of a fit that takes them in.
        return FringeSolution((replace(fit(moved, replace(warm, prior=first.prior), known=known), ends=ends),), moved)

    for _ in range(2):
        costs = held.misses(early, limit(early.s, grid[:, None]), per_um) / held.noise**2
        held = at(float(grid[np.argmin(costs)]), held).best
    # A phase and its mirror image at the nearest extreme make nearly the same signal, and each is looked at closely.
    beside = np.pad(costs, 1, constant_values=np.inf)
    lows = np.flatnonzero((costs <= beside[:-2]) & (costs <= beside[2:]))
    # Between two steps of the grid a low may lie deeper, by less than it rises to its neighbours.
    depth = costs[lows] - np.minimum(beside[:-2], beside[2:])[lows]
    likely = costs[lows] + np.where(np.isfinite(depth), depth, 0.0) < costs.min() + _CLOSE
    laid, tried = list[tuple[FringeSolution, float, float]](), (float(grid.min()), float(grid.max()))
    for i in lows[likely][np.argsort(costs[lows[likely]])][:_PEAKS]:
        around = 0.5 * abs(float(grid[min(i + 1, len(grid) - 1)] - grid[max(i - 1, 0)]))
        laid += _laid(at, held, float(grid[i]), around, tried)
    best, value, width = max(laid, key=lambda each: each[0].best.evidence)
    phase, further = best.best.phase(np.array([value, value + 1e-6]), per_um)
    image = value + 2e-6 * (np.round(phase / np.pi) * np.pi - phase) / (further - phase)
    # Where the course turns the image may lie beyond the sweep's other end, where it is none.
    if -order * image < 1.0:
        laid += _laid(at, best.best, float(image), 4.0 * width, tried)
    best, value, _ = max(laid, key=lambda each: each[0].best.evidence)
    share = np.array([w * (abs(v) < 1.0) * np.exp(each.best.evidence - best.best.evidence) for each, v, w in laid])
    change = np.array([each.best.change[0] for each, *_ in laid]) - best.best.change[0]
    found = at(value, best.best, None, whole)
    told = replace(found.best, ends_variance=float(share @ change**2 / (share.sum() + 1e-300)))
    covered = float(share.sum() * abs(further - phase) / 1e-6)
    prior = float(np.log(odds * min(covered / (2.0 * np.pi * _MOST_LATE), 1.0) + 1e-300))
    return Followed(replace(found, fits=(told,)), per_um, *told.ends, prior=prior)


def _lagged(whole: Samples, size: int, smooth: Followed, fit: _Fitter) -> Followed:
    """A mirror that lags: the best of some lags, then one more unknown of the fit."""
    per_um, held = smooth.phase_per_um, smooth.solution.best
    fits = []
    for lag in _LAGS.tolist():
        held = fit(_chunked(_lagging(whole, lag), size), held)
        fits.append((held, lag))
    held, lag = max(fits, key=lambda each: each[0].evidence)
    for _ in range(_ROUNDS):
        moved = _lagging(whole, lag)
        shift = _chunked(replace(moved, s=(_lagging(whole, 1.0001 * lag).s - moved.s) / 1e-4), size).s
        moved = _chunked(moved, size)
        held = fit(moved, held, slope=per_um * slopes_at(held.profile, moved.s) * shift)
        step, sd = float(held.unknowns[-1]), float(np.sqrt(held.unknowns_covariance[-1, -1]))
        lag *= float(np.exp(np.clip(step, -0.5, 0.5)))
        if abs(step) < 0.1 * sd:
            break

    def at(value: float) -> FringeSolution:
        moved = _lagging(whole, value)
        # A mirror that lags does not reach the end with its joint.
        ends, moved = (float(moved.s[0]), float(moved.s[-1])), _chunked(moved, size)
        return FringeSolution((replace(fit(moved, held), ends=ends),), moved)

    found = at(lag)
    beside = at(lag * np.exp(min(sd, 0.5))).best.change[0] - found.best.change[0]
    return Followed(
        replace(found, fits=(replace(found.best, ends_variance=beside**2),)),
        per_um,
        lag=lag,
        prior=float(np.log(_LAG_ODDS)),
    )


def _laid(
    at: Callable[[float, Fit], FringeSolution], held: Fit, value: float, width: float, tried: tuple[float, float]
) -> list[tuple[FringeSolution, float, float]]:
    """Fits around a number, which need not be normal, with the numbers and the width that each stands for."""
    for _ in range(_ROUNDS):
        # Beyond the sweep's own ends, and those that are tried, a place is none.
        near = np.clip(value + width * np.linspace(-1.0, 1.0, 9), *tried)
        found = [at(float(each), held) for each in near]
        evidence = np.array([each.best.evidence for each in found])
        share = np.exp(evidence - evidence.max())
        held, value = found[int(np.argmax(share))].best, float(near[int(np.argmax(share))])
        outside = (share * (np.abs(near) < 1.0))[[0, -1]].max() >= 0.05
        if (share > 0.05).sum() >= 3 and not outside:
            break
        if outside:
            width *= 1.5
            continue
        # A parabola through the best three tells where and how wide the next ones lie.
        i = int(np.clip(np.argmax(share), 1, 7))
        low, mid, high = evidence[i - 1 : i + 2]
        bend = max(2.0 * mid - low - high, 1e-3)
        value += 0.25 * width * 0.5 * (high - low) / bend
        width *= float(np.clip(0.75 / np.sqrt(bend), 0.1, 0.5))
    return [(each, float(v), 0.25 * width) for each, v in zip(found, near, strict=True)]


def _uneven(base: Followed, profile: DisplacementProfile, fit: _Fitter) -> list[Followed]:
    """Fits of courses with more and more polynomials, along the places of `base`, until one holds."""
    old, moved = base.solution.best, base.solution.samples
    begin = _demodulated(old, moved, base.phase_per_um)
    tried: list[Followed] = []
    for degree, size in _COURSES:
        if len(moved) <= 2 * degree:
            break
        best = fit(moved, None, loosened(profile, degree, size), begin[:degree])
        tried.append(replace(base, solution=FringeSolution((best,), moved), size=size))
        holds = tried[-1].errors.probability > UNLIKELY
        for _ in range(_SIZINGS if holds else 0):
            # The polynomials that the joint makes less of tell how large the course is.
            prior, joint = loosened(profile, degree, size), np.pad(profile.covariance, (0, degree - DEGREE))
            room, own = np.diag(prior.covariance - joint), (best.profile - prior.mean) ** 2 + np.diag(best.covariance)
            told = room > np.diag(joint)
            # A fit of few fringes need not be a maximum, and tells nothing then.
            if not own[told].sum() > 0.0:
                break
            wanted = size * float(np.sqrt(own[told].sum() / room[told].sum()))
            better = fit(moved, None, loosened(profile, degree, wanted), best.profile)
            if better.evidence < best.evidence:
                break
            best, size = better, wanted
        best = replace(best, ends=old.ends, ends_variance=old.ends_variance)
        tried[-1] = replace(base, solution=FringeSolution((best,), moved), size=size)
        if holds and best.evidence < max(each.solution.best.evidence for each in tried):
            break
    return tried


def _hopped(best: Followed, whole: Samples, size: int, smooth: Followed, fit: _Fitter) -> Followed:
    """The same, with the hop of the phase on the joint's course that explains the trace as well, if one does."""
    used, held = smooth.solution.samples, smooth.solution.best
    after = np.arange(len(whole))

    def at(place: int) -> Fit:
        return fit(used, held, slope=_chunked(replace(whole, s=(after >= place).astype(float)), size).s)

    step = max(1, len(whole) // _HOPS)
    tried = {place: at(place) for place in range(step, len(whole), step)}
    while step > 1:
        place = max(tried, key=lambda each: tried[each].evidence)
        step = max(1, step // 4)
        tried |= {near: at(near) for near in range(place - 3 * step, place + 4 * step, step) if near not in tried}
    found = max(tried.values(), key=lambda each: each.evidence)
    return replace(best, hop=float(found.unknowns[-1])) if found.evidence > best.evidence else best


def _demodulated(fit: Fit, samples: Samples, phase_per_um: float) -> Floats:
    """Coefficients of a profile by the phase of the fringes against that of a fit."""
    degree = _COURSES[-1][0]
    basis = legendre(samples.s, degree)
    width = _AVERAGED * len(samples) / max(path_fringes(fit.profile, phase_per_um), 1.0)
    turned = gaussian_filter1d(samples.levelled() * np.exp(-1j * fit.phase(samples.s, phase_per_um)), width)
    phase = np.unwrap(np.angle(turned)) / phase_per_um
    # A ridge keeps high polynomials from following what the averages cannot.
    ridge = 1e-3 * len(samples) * np.diag(np.arange(degree + 1.0) ** 2 / degree**2)
    found = np.linalg.solve(basis.T @ basis + ridge, basis.T @ phase)[1:]
    found[: len(fit.profile)] += fit.profile[:degree]
    return np.asarray(found)
