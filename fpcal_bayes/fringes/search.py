"""Which profiles of the cavity length may have made a trace: starting points for the fit.

A profile is split into its slope, what goes with it by the prior, and its largest bend beside it. For each bend the
signal is turned back by the bend's phase; a Fourier transform then weighs all slopes at once. The true profile stands
out however often L turns back, since all parts of the sweep add up in phase.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.kernels import floating_fits, turned_bins
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, legendre
from fpcal_bayes.fringes.samples import Samples

#: Courses are sought within this many standard deviations of the prior.
_REACH = 4.5
#: Bins of the samples used, and of one fringe at the steepest slope.
_MOST_BINS, _BINS_A_FRINGE = 1200, 8
#: Phase in rad between two bends tried.
_BEND_PHASE = 1.0
#: Below this many fringes the offset is fitted along with the fringes.
_FEW_FRINGES = 4.0


@dataclass(frozen=True)
class Split:
    """A profile as base + slope a + bend b, each of shape (DEGREE,), with the ranges of a and b in um."""

    base: Floats
    slope: Floats
    bend: Floats
    slope_range: tuple[float, float]
    bend_range: tuple[float, float]


def split_profile(profile: DisplacementProfile) -> Split:
    """Split a prior of courses into its slope and its largest bend beside it."""
    covariance, mean = profile.covariance, profile.mean
    slope = covariance[:, 0] / covariance[0, 0]
    rest = covariance - np.outer(slope, slope) * covariance[0, 0]
    values, vectors = np.linalg.eigh(rest)
    bend, bend_sd = vectors[:, -1], float(np.sqrt(max(values[-1], 0.0)))
    reach = _REACH * float(np.sqrt(covariance[0, 0]))
    return Split(
        base=mean - slope * mean[0],
        slope=slope,
        bend=bend,
        slope_range=(mean[0] - reach, mean[0] + reach),
        bend_range=(-_REACH * bend_sd, _REACH * bend_sd),
    )


def find_profiles(samples: Samples, profile: DisplacementProfile, phase_per_um: float, most: int = 8) -> Floats:
    """Coefficients (m, DEGREE) in um of courses that may have made the signal, best first.

    A profile and its mirror image, which make the same signal, count as one.
    """
    split = split_profile(profile)
    used = samples.binned(_MOST_BINS)
    # Beyond two samples a fringe a slope cannot be told from a smaller one.
    steepest = 0.5 * len(samples) * np.pi / phase_per_um
    low, high = np.clip(split.slope_range, -steepest, steepest)
    reach = max(abs(low), abs(high), 2.0 * np.pi / phase_per_um)
    bends = _bends(split, phase_per_um)
    found, scores = _by_transform(used, split, bends, phase_per_um, reach, (low, high))
    few = _FEW_FRINGES * np.pi / phase_per_um
    if len(found) == 0 or abs(found[0, 0]) < few or scores[0] < 0.5:
        slow, left = _by_fits(used.binned(120), split, bends[::2], phase_per_um, min(few, reach))
        found, scores = np.concatenate([found, slow]), np.concatenate([scores, left])
    order = np.argsort(-scores)
    return _distinct(found[order], phase_per_um, most)


def _bends(split: Split, phase_per_um: float) -> Floats:
    step = _BEND_PHASE / phase_per_um
    low, high = split.bend_range
    n = max(1, int(np.ceil((high - low) / step)))
    return np.linspace(low, high, n) if n > 1 else np.zeros(1)


def _by_transform(
    used: Samples, split: Split, bends: Floats, phase_per_um: float, reach: float, slopes: tuple[float, float]
) -> tuple[Floats, Floats]:
    basis, signal = legendre(used.s), used.levelled()
    curves = phase_per_um * (basis[:, 1:] @ np.array([split.base, split.slope, split.bend]).T)
    base, slope, bend = np.ascontiguousarray(curves.T)
    cycles = slope / (2.0 * np.pi)
    width = 1.0 / (_BINS_A_FRINGE * reach)
    first = cycles.min()
    place = np.rint((cycles - first) / width).astype(np.int64)
    n_bins = int(place.max()) + 1
    n_fast = scipy.fft.next_fast_len(2 * n_bins)
    bins = turned_bins(used.count * signal, place, base, bend, bends, n_bins)
    spectrum = scipy.fft.fft(bins, n_fast, axis=1)
    frequency = scipy.fft.fftfreq(n_fast, width)
    order = np.argsort(frequency, kind="stable")
    # The neighbours beyond either end stand for a range narrower than a step.
    step = 1.0 / (n_fast * width)
    order = order[(frequency[order] > slopes[0] - step) & (frequency[order] < slopes[1] + step)]
    total = float((used.count * signal**2).sum() * used.count.sum())
    power = 2.0 * np.abs(spectrum[:, order]) ** 2 / total
    if power.size == 0:
        return np.zeros((0, DEGREE)), np.zeros(0)
    b, a = _peaks(power)
    found = split.base + np.outer(frequency[order][a], split.slope) + np.outer(bends[b], split.bend)
    return found, power[b, a]


def _by_fits(used: Samples, split: Split, bends: Floats, phase_per_um: float, reach: float) -> tuple[Floats, Floats]:
    basis = legendre(used.s)
    curves = phase_per_um * (basis[:, 1:] @ np.array([split.base, split.slope, split.bend]).T)
    base, slope, bend = np.ascontiguousarray(curves.T)
    low, high = max(-reach, split.slope_range[0]), min(reach, split.slope_range[1])
    if low >= high:
        return np.zeros((0, DEGREE)), np.zeros(0)
    slopes = np.linspace(low, high, max(2, int((high - low) * phase_per_um / 0.8)))
    signal = used.signal - used.signal.mean()
    left = floating_fits(used.s, signal, used.count, base, slope, bend, slopes, bends)
    explained = 1.0 - left / float((used.count * signal**2).sum())
    a, b = _peaks(explained)
    found = split.base + np.outer(slopes[a], split.slope) + np.outer(bends[b], split.bend)
    return found, explained[a, b]


def _peaks(values: Floats, most: int = 24, least: float = 0.4) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places of the highest local maxima of a table, those above a share of the highest."""
    padded = np.pad(values, 1, constant_values=-np.inf)
    is_peak = values > least * values.max()
    for i in (0, 1, 2):
        for j in (0, 1, 2):
            if (i, j) != (1, 1):
                is_peak &= values >= padded[i : i + values.shape[0], j : j + values.shape[1]]
    rows, columns = np.nonzero(is_peak)
    order = np.argsort(-values[rows, columns])[:most]
    return rows[order], columns[order]


def _distinct(found: Floats, phase_per_um: float, most: int) -> Floats:
    """The first of courses that are alike or mirror images; `found` is best first."""
    near = 1.5 / phase_per_um
    kept: list[Floats] = []
    for candidate in found:
        if all(min(np.abs(candidate - k).max(), np.abs(candidate + k).max()) > near for k in kept):
            kept.append(candidate)
            if len(kept) == most:
                break
    return np.array(kept).reshape(-1, DEGREE)
