"""Readings of traces, one by one and of a whole campaign."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.count import ALONE, CountDecision, Reading, SignSource, decide, shared_odds
from fpcal_bayes.fringes.fit import CALM, LIVELY, Fit, Nuisance
from fpcal_bayes.fringes.follow import DOUBTED, UNLIKELY, Followed, follow, hidden
from fpcal_bayes.fringes.misfit import PhaseErrors, fringes_seen
from fpcal_bayes.fringes.profile import DisplacementProfile, lengths_at, slopes_at
from fpcal_bayes.fringes.samples import Samples, fault
from fpcal_bayes.fringes.solve import path_fringes, rescaled, solve, with_noise

#: Samples a fringe below which a trace is refused, on average and where L moves fastest.
SPARSE, SPARSEST = 3.0, 2.1
#: A fringe amplitude below this many standard deviations of the noise is none.
_FAINT = 5.0
#: Above this standard deviation, in um, a count is not certain: a fit near its edges is not as normal as it says.
_VAGUE = 0.03
#: The same of a mirror that goes its own way past so few fringes: it may have turned back between two of them.
_VAGUE_ASTRAY, _FEW_ASTRAY = 0.01, 4.0
#: Fringes below which amplitude and profile cannot be told apart for certain.
_FEWEST_FRINGES = 0.9
#: Residuals this much above the campaign's noise mean that the sweep was not what it should have been.
_MISFIT = 3.0
#: The same above the noise that the cell states, where residuals exceed this share of the fringe amplitude too.
_VISIBLE = 0.05
#: Residuals of a mirror that goes its own way may reach this share of the fringe amplitude.
_ROUGH = 0.25
#: Phase errors of blocks, in rad, and their mean square by the noise, above which a fit does not hold.
_OFF_PHASE, _OFF_SQUARE = 0.3, 25.0
#: Mean square of some samples in a row, by the noise, above which a hop may spoil a course of its own, and does.
_MAY_JUMP, _JUMP = 7.0, 25.0
#: Fringes that a mirror may go astray, or stand still, before the joint's position means nothing.
_ASTRAY, _STILL = 2.0, 2.25
#: An uneven course that runs back by this much more than its joint's, in um, may have been mirrored.
_TURNED = 0.005
#: A turn this near to an extreme of the fringe, in half fringes, may be none.
_AT_EXTREME = 0.15
#: A late start below this, in um, is left to the uncertainty.
_SHORT = 0.01
#: A mirror is followed anew if the other traces change the probability of a late start, or an early stop, by this.
_CHANGED = 1e-3
#: What an uneven course adds to the standard deviation of an expected change, in um.
_UNEVEN = 0.5
#: Standard deviation of an estimate's prediction is doubled, with this much added, in um: the cell drifts.
_DRIFTED = 0.02
#: Weight, in readings, of the campaign's noise against a trace's own.
_POOL_WEIGHT = 60.0


@dataclass(frozen=True)
class Recorded:
    """One sweep as the reader takes it."""

    label: str  # of the sweep
    samples: Samples  # laid along it
    start: float  # of the joint that moves, in um or rad
    end: float  # the same at its other end
    profile: DisplacementProfile  # what the cell's priors know of it
    wavelength: float  # in the air of the cavity, in um
    wavelength_share: float = 0.0  # its relative standard deviation
    fading: Nuisance = LIVELY  # how visibility may fade along it
    joint: int = 0  # that moves
    errs: bool = False  # whether the cell states error motions, which no joint's course has
    ripple: float = 0.0  # standard deviation of the joint's periodic error, which no course follows, in um or rad
    #: Changes that others expect, the most trustworthy first; the cell's priors need not be named.
    sign_sources: tuple[SignSource, ...] = ()

    @property
    def phase_per_um(self) -> float:
        """4 pi n / wavelength."""
        return 4.0 * np.pi / self.wavelength


def read_traces(
    recorded: Sequence[Recorded],
    *,
    noise: float | None = None,
    full_scale: float | None = None,
    mirror_light: float = 0.0,
) -> list[Reading]:
    """One reading for each trace of a campaign.

    noise: standard deviation of one sample in V to begin with. full_scale: volts at which the converter is at its end.
    mirror_light: light of the mirror alone over the square of the fringe amplitude, about, in 1 / V.
    """
    faults = [fault(each.samples, full_scale) or _beyond_sampling(each) for each in recorded]
    solutions = [
        None if why else solve(each.samples, each.profile, each.phase_per_um, noise, mirror_light, each.fading)
        for each, why in zip(recorded, faults, strict=True)
    ]
    courses = [
        None if solution is None else Followed(solution, each.phase_per_um)
        for each, solution in zip(recorded, solutions, strict=True)
    ]
    pool = _Pool.of([course.solution.best for course in courses if course])
    # What a defect leaves, which all may share, is no noise.
    calm = _Pool.of([course.solution.best for course in courses if course and course.errors.probability > DOUBTED])
    looks = [
        None if why else _Look.of(each, course, calm, noise, mirror_light)
        for each, why, course in zip(recorded, faults, courses, strict=True)
    ]
    told = [look.known.told[:, 0] if look and look.known else np.full(2, np.nan) for look in looks]
    odds = shared_odds(np.reshape(told, (-1, 2)), np.array([each.joint for each in recorded]))
    readings = []
    for each, why, look, likely in zip(recorded, faults, looks, odds, strict=True):
        course = look.settled(likely) if look else None
        if course is None or _faint(course[0].solution.best, each.samples):
            readings.append(Reading(each.label, refused=why or _unseen(each), phase_per_um=each.phase_per_um))
            continue
        readings.append(_reading(each, *course, _excess(course[0], pool, noise)))
    return readings


@dataclass(frozen=True)
class _Look:
    """A trace looked at alone."""

    each: Recorded
    smooth: Followed | None  # the joint's course, where it has any likeness
    follow: Callable[..., Followed | None]  # the mirror's at given odds of a late start and an early stop
    known: Followed | None  # the joint's course where it explains the trace, else the mirror's at odds of one trace
    errors: PhaseErrors | None  # what the joint's course leaves where it explains the trace

    @classmethod
    def of(
        cls, each: Recorded, smooth: Followed | None, pool: "_Pool | None", noise: float | None, mirror_light: float
    ) -> "_Look":
        errors = None
        if smooth is not None:
            old, left = smooth.solution, smooth.errors
            sd = pool.noise_of(old.best)[0] if pool else old.best.noise
            new = rescaled(old, sd)
            if abs(np.log(sd / old.best.noise)) > 0.05:
                new = with_noise(old, each.profile, each.phase_per_um, sd, mirror_light)
            smooth = None if _faint(new.best, each.samples) else replace(smooth, solution=new)
            if smooth is not None and left.probability > DOUBTED and not each.errs:
                ends = [hidden(new.best, each.samples, each.phase_per_um, end) for end in (-1.0, 1.0)]
                smooth, errors = replace(smooth, told=np.array(ends)), left
        course, nuisance = (None, CALM) if smooth is None else (smooth.solution, smooth.solution.best.nuisance)
        sd = noise or 0.005 * float(np.ptp(each.samples.signal))
        given = each.samples, each.profile, each.phase_per_um, course, nuisance, sd, mirror_light
        again = partial(follow, *given, errs=each.errs)
        return cls(each, smooth, again, again() if errors is None else smooth, errors)

    def settled(self, odds: Floats) -> tuple[Followed, PhaseErrors] | None:
        """The course of the mirror by the odds (2,) of a late start and an early stop, and what its fit leaves."""
        each, smooth, found = self.each, self.smooth, self.known
        if found is None:
            return None
        ratio, squares = np.nan_to_num(found.told.T)
        share, alone = (likely * ratio / (1.0 + likely * ratio) for likely in (odds, ALONE))
        variance = float(odds @ (squares / (1.0 + odds * ratio)))
        # The start and the end are fitted where it matters.
        if self.errors is not None and variance < _SHORT**2:
            return _widened(found, variance), self.errors
        if self.errors is not None or np.abs(share - alone).max() > _CHANGED:
            found = self.follow(odds=odds.tolist()) or found
        if smooth is not None and not found.astray:
            # Another course may still be nearly as likely.
            found = _widened(smooth, found.solution.best.ends_variance)
        # What is left beyond noise counts as slow noise, and either end may be off by as much as the blocks are.
        errors = found.errors
        solution = rescaled(found.solution, max(1.0, errors.excess) ** 0.5 * found.solution.best.noise)
        best = found.solution.best
        slopes = slopes_at(best.profile, np.array(best.ends)) * 2.0 / (each.end - each.start)
        added = each.ripple**2 * float(slopes @ slopes)
        jumps = found.uneven and errors.worst > _MAY_JUMP
        if jumps or errors.probability < UNLIKELY:
            added += 2.0 * max(float(np.mean(errors.phase**2 - errors.sd**2)), 0.0) / each.phase_per_um**2
            if jumps:
                # A hop leaves half of itself to either side, at half height of the fringe.
                added += 4.0 * errors.worst * (best.noise / best.amplitude / each.phase_per_um) ** 2
        return _widened(replace(found, solution=solution), added), errors


def _widened(found: Followed, variance: float) -> Followed:
    fits = tuple(replace(fit, ends_variance=fit.ends_variance + variance) for fit in found.solution.fits)
    return replace(found, solution=replace(found.solution, fits=fits))


def _faint(fit: Fit, samples: Samples) -> bool:
    return bool(fit.amplitude < _FAINT * fit.noise / np.sqrt(max(1.0, len(samples) / 50)))


def _unseen(each: Recorded, seen: float | None = None) -> str:
    """Why a trace is not read where its fringes are not those that the joint lets expect."""
    seen = fringes_seen(each.samples) if seen is None else seen
    expected = path_fringes(each.profile.mean, each.phase_per_um)
    if seen < _ASTRAY:
        return "no fringes are seen"
    if round(seen) == round(expected):
        return (
            f"{seen:.0f} fringes are seen as expected, but not where the joint's readings place them: check their times"
        )
    return f"{expected:.0f} fringes expected, {seen:.0f} seen: check the joint's unit and scale"


def _excess(found: Followed, pool: "_Pool | None", stated: float | None) -> float:
    """Residuals relative to what the campaign lets expect, and to what the cell states where they are seen by eye."""
    fit = found.solution.best
    own = np.sqrt(fit.residual_squares / fit.freedom) if fit.freedom > 3 else fit.noise
    # A mirror that goes its own way is held against its fringes alone.
    if found.astray and own < _ROUGH * fit.amplitude:
        return 1.0
    beside = float(own / stated) if stated and own > _VISIBLE * fit.amplitude else 1.0
    return max(pool.noise_of(fit)[1] if pool else 1.0, beside)


@dataclass(frozen=True)
class _Pool:
    """Noise that the traces of a campaign share: in V, or relative to the fringe amplitude."""

    level: float
    relative: bool

    @classmethod
    def of(cls, fits: Sequence[Fit]) -> "_Pool | None":
        rich = [fit for fit in fits if fit.freedom > 5]
        if len(rich) < 5:
            return None
        own = np.array([np.sqrt(fit.residual_squares / fit.freedom) for fit in rich])
        size = np.array([fit.amplitude for fit in rich])
        freedom = np.minimum(np.array([fit.freedom for fit in rich]), 100.0)
        median = partial(np.quantile, q=0.5, weights=freedom, method="inverted_cdf")
        choices = []
        for relative, values in ((False, own), (True, own / size)):
            logs = np.log(np.maximum(values, 1e-12))
            centre = median(logs)
            choices.append((median(np.abs(logs - centre)), relative, centre))
        _, relative, centre = min(choices)
        # Around the median, the mean square is the better estimate.
        values = np.log(np.maximum(own / size if relative else own, 1e-12))
        near = np.abs(values - centre) < 0.5
        return cls(float(np.sqrt((freedom[near] @ np.exp(2.0 * values[near])) / freedom[near].sum())), relative)

    def noise_of(self, fit: Fit) -> tuple[float, float]:
        """Noise of one reading of a trace in V, and its residuals relative to what the campaign lets expect."""
        expected = self.level * (fit.amplitude if self.relative else 1.0)
        freedom = max(fit.freedom, 0.0)
        square = (_POOL_WEIGHT * expected**2 + fit.residual_squares) / (_POOL_WEIGHT + freedom)
        return float(np.sqrt(square)), float(np.sqrt(fit.residual_squares / freedom) / expected if freedom > 3 else 1.0)


def _reading(each: Recorded, found: Followed, errors: PhaseErrors, excess: float) -> Reading:
    solution, late, missing = found.solution, *found.missed()
    prior = SignSource(each.profile.dl, 1.5 * each.profile.dl_sd, "prior")
    # A mirror that goes its own way may change by another length than the joint lets expect.
    room = late + missing + _UNEVEN * found.uneven
    expected = [replace(source, sd=float(np.hypot(source.sd, room))) for source in (*each.sign_sources, prior)]
    verdict = decide(solution.fits, expected)
    fit = verdict.fit
    dl, sd = fit.change
    sign = -1.0 if verdict.mirrored else 1.0
    if not verdict.signed and sign * dl < 0:
        sign = -sign
    fringes = path_fringes(fit.profile, each.phase_per_um)
    turns = _turns(fit)
    density, least = _density(each.samples, fit.profile, each.phase_per_um)
    known = Reading(
        label=each.label,
        fringes=fringes - (late + missing) * each.phase_per_um / (2.0 * np.pi),
        samples_a_fringe=density,
        noise=fit.noise,
        amplitude=fit.amplitude,
        phase_per_um=each.phase_per_um,
        fit=fit,
    )
    if found.astray:
        per_um = each.phase_per_um / (2.0 * np.pi)
        wanted = path_fringes(each.profile.mean, each.phase_per_um)
        if abs(fringes - wanted) > _ASTRAY + (6.0 * each.profile.dl_sd + late + missing) * per_um:
            return replace(known, refused=_unseen(each, fringes))
    if density < SPARSE or least < SPARSEST:
        seen = f"{min(density, least):.2g} samples a fringe"
        return replace(known, refused=f"sparse: {seen}, expected {SPARSE:g} or more")
    sigma = sd if verdict.signed else float(np.hypot(sd, each.wavelength_share * dl))
    strayed = _strayed(each, found, errors, verdict, sd)
    return replace(
        known,
        dl=sign * dl,
        sigma=sigma,
        signed=verdict.signed,
        sign_source=verdict.sign_source,
        turns=tuple(turns.tolist()),
        reversals=tuple(((each.start + each.end) / 2.0 + turns * (each.end - each.start) / 2.0).tolist()),
        set_out=found.set_out,
        stop=found.stop,
        late=(found.set_out - found.stop + 2.0) / 2.0 * abs(each.end - each.start),
        uneven=found.uneven,
        doubt=strayed or _doubt(verdict, sd, excess, fringes, each.errs or found.astray),
        strayed=bool(strayed),
        alternatives=verdict.alternatives if verdict.doubtful else (),
        profile=sign * fit.profile,
        profile_covariance=fit.covariance,
        wavelength_share=each.wavelength_share,
    )


def _doubt(verdict: CountDecision, sd: float, excess: float, fringes: float, astray: bool) -> str:
    if verdict.doubtful:
        return f"another count of fringes is possible (probability {verdict.other_counts:.2g})"
    if astray and sd > (_VAGUE if fringes > _FEW_ASTRAY else _VAGUE_ASTRAY):
        return f"the signal does not follow a smooth sweep (sigma {1e3 * sd:.0f} nm)"
    if fringes < _FEWEST_FRINGES or sd > _VAGUE:
        return f"too few fringes to measure with ({fringes:.2f}, sigma {1e3 * sd:.0f} nm)"
    if excess > _MISFIT:
        return f"the signal does not follow a smooth sweep (residuals {excess:.1f} times the noise)"
    return ""


def _strayed(each: Recorded, found: Followed, errors: PhaseErrors, verdict: CountDecision, sd: float) -> str:
    """Why a reading is not relied on by what the mirror did."""
    late, missing = found.missed()
    fringe = 2.0 * np.pi / each.phase_per_um
    if np.sqrt(np.mean(errors.phase**2)) > _OFF_PHASE or errors.excess > _OFF_SQUARE:
        return f"the signal does not follow a smooth sweep (phase errors {errors.excess**0.5:.1f} times the noise)"
    if found.astray and errors.worst > _JUMP:
        off = errors.worst**0.5
        return f"the signal does not follow a smooth sweep (it jumps: samples in a row {off:.0f} times the noise off)"
    if found.hop:
        return f"the phase hops by {abs(found.hop):.2g} rad: the laser or the mirror jumps"
    if late > _STILL * fringe:
        return f"the mirror sets out {late:.2f} um late: its pose at the start is not that of the joint"
    if found.stop < 1.0 and missing > _STILL * fringe:
        return f"the mirror stops {missing:.2f} um early: its pose at the end is not that of the joint"
    if found.stop == 1.0 and missing > 3.0 * sd:
        return f"the trace ends {1e3 * missing:.0f} nm before the mirror stands still"
    if not (found.uneven or found.lag) and sd > _VAGUE and 2.0 * verdict.fit.ends_variance > sd**2:
        return (
            f"the mirror may set out, or stop, elsewhere: an extreme of the fringe hides it (sigma {1e3 * sd:.0f} nm)"
        )
    if found.uneven and _turned_back(found, verdict.fit.profile) > _TURNED + _turned_back(found, each.profile.mean):
        turns = verdict.fit.phase(_turns(verdict.fit), each.phase_per_um) / np.pi
        if (np.abs(turns - np.rint(turns)) < _AT_EXTREME).any():
            return "the course seems to turn back at an extreme of the fringe, which its mirror image explains as well"
    for source in each.sign_sources:
        off = min(abs(verdict.fit.change[0] - source.dl), abs(verdict.fit.change[0] + source.dl))
        if source.sd < fringe / 8.0 and off > 6.0 * np.hypot(source.sd, sd) + _UNEVEN * found.uneven + late:
            return (
                f"{off / fringe:.1f} fringes beside what {source.source} expects: a jump within the trace, or the cell "
                "has moved"
            )
    return ""


def _turned_back(found: Followed, profile: Floats) -> float:
    """How far L runs against its own change along a sweep, in um."""
    lengths = lengths_at(profile, np.linspace(*found.solution.best.ends, 1025))
    return float(np.abs(np.diff(lengths)).sum() - abs(lengths[-1] - lengths[0])) / 2.0


def _turns(fit: Fit) -> Floats:
    """Places s at which a profile turns, those apart whose turning back is less than what is uncertain."""
    series = np.polynomial.legendre.Legendre([0.0, *fit.profile])
    slope = series.deriv()
    roots = slope.roots() if np.abs(slope.coef).max() > 0 else np.zeros(0)
    real = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
    turns = list(real[(real > -1) & (real < 1)])
    least = 3.0 * fit.change[1] + 1e-3
    # The smallest swing goes first, with the turn that ends it, until all that is left is certain.
    while turns:
        swings = np.abs(np.diff(series(np.array([-1.0, *turns, 1.0]))))
        i = int(np.argmin(swings))
        if swings[i] > least:
            break
        del turns[max(i - 1, 0) : min(i + 1, len(turns))]
    return np.array(turns)


def _density(samples: Samples, profile: Floats, phase_per_um: float) -> tuple[float, float]:
    """Samples a fringe along a profile: on average over the moving part, and where it is least dense."""
    turned = np.abs(np.diff(lengths_at(profile, samples.s))) * phase_per_um / (2.0 * np.pi)
    moving = np.abs(np.diff(samples.s)) > 0.05 * 2.0 / len(samples)
    passed, fast = float(turned.sum()), float(np.quantile(turned, 0.98)) if len(turned) else 0.0
    return (float(moving.sum()) / passed if passed > 0 else np.inf), (1.0 / fast if fast > 0 else np.inf)


def _beyond_sampling(each: Recorded) -> str:
    """Why the samples cannot follow the change that is expected with certainty; empty if they can."""
    for sign_source in (*each.sign_sources, SignSource(each.profile.dl, each.profile.dl_sd, "the cell's priors")):
        fringes = (abs(sign_source.dl) - 6.0 * sign_source.sd) * each.phase_per_um / (2.0 * np.pi)
        if fringes > 0 and len(each.samples) / fringes < SPARSE:
            return f"sparse: {len(each.samples)} samples for {fringes:.0f} fringes or more, by {sign_source.source}"
    return ""


def estimate_sign_source(profile: DisplacementProfile) -> SignSource:
    """What an estimate expects, with room for drift since it was made."""
    return SignSource(profile.dl, 2.0 * profile.dl_sd + _DRIFTED, "estimate")
