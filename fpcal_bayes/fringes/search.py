"""Which profiles of the cavity length may have made a trace: starting points for the fit.

A profile is split into its slope, what goes with it by the prior, and its largest bend beside it. For each bend the
signal is turned back by the bend's phase; a Fourier transform then weighs all slopes at once. The true profile stands
out however often L turns back, since all parts of the sweep add up in phase.
"""

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from fpcal_bayes.core.typing import Floats
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


def find_profiles(samples: Samples, profile: DisplacementProfile, phase_per_um: float, most: int = 8) -> Floats:
    """Coefficients (m, DEGREE) in um of courses that may have made the signal, best first, mirror images once."""
    # A prior of courses has its slope with what goes with it, and its largest bend beside it.
    covariance, mean = profile.covariance, profile.mean
    slope = covariance[:, 0] / covariance[0, 0]
    values, vectors = np.linalg.eigh(covariance - np.outer(slope, slope) * covariance[0, 0])
    split = np.array([mean - slope * mean[0], slope, vectors[:, -1]])
    room, bent = _REACH * float(np.sqrt(covariance[0, 0])), _REACH * float(np.sqrt(max(values[-1], 0.0)))
    used = samples.binned(_MOST_BINS)
    # Beyond two samples a fringe a slope cannot be told from a smaller one.
    steepest = 0.5 * len(samples) * np.pi / phase_per_um
    low, high = np.clip((mean[0] - room, mean[0] + room), -steepest, steepest).tolist()
    reach = max(abs(low), abs(high), 2.0 * np.pi / phase_per_um)
    n = int(np.ceil(2.0 * bent * phase_per_um / _BEND_PHASE))
    bends = np.linspace(-bent, bent, n) if n > 1 else np.zeros(1)
    found, scores = _by_transform(used, split, bends, phase_per_um, reach, (low, high))
    few = _FEW_FRINGES * np.pi / phase_per_um
    if len(found) == 0 or abs(found[0, 0]) < few or scores[0] < 0.5:
        near = min(few, reach)
        slopes = max(-near, float(mean[0]) - room), min(near, float(mean[0]) + room)
        slow, left = _by_fits(used.binned(120), split, bends[::2], phase_per_um, slopes)
        found, scores = np.concatenate([found, slow]), np.concatenate([scores, left])
    found = found[np.argsort(-scores)]
    return found[distinct(found, np.full(len(found), 1.5 / phase_per_um))[:most]]


def _by_transform(
    used: Samples, split: Floats, bends: Floats, phase_per_um: float, reach: float, slopes: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Courses base + slope a + bend b, `split` being these three (3, DEGREE), and how well each explains the signal."""
    signal = used.levelled()
    base, slope, bend = (phase_per_um * (legendre(used.s)[:, 1:] @ split.T)).T
    cycles = slope / (2.0 * np.pi)
    width = 1.0 / (_BINS_A_FRINGE * reach)
    place = np.rint((cycles - cycles.min()) / width).astype(np.int64)
    n_bins = int(place.max()) + 1
    # The signal turned back by each bend's phase, as far from one as from the next, is summed into bins of the slope's.
    turned = np.empty((len(bends), len(used)), dtype=complex)
    turned[0] = used.count * signal * np.exp(-1j * (base + bends[0] * bend))
    further = np.exp(-1j * np.diff(bends[:2]).sum() * bend)
    for i in range(1, len(bends)):
        turned[i] = turned[i - 1] * further
    into = (place + n_bins * np.arange(len(bends))[:, None]).ravel()
    real, imaginary = (np.bincount(into, part.ravel(), n_bins * len(bends)) for part in (turned.real, turned.imag))
    summed = (real + 1j * imaginary).reshape(len(bends), n_bins)
    n_fast = scipy.fft.next_fast_len(2 * n_bins)
    spectrum = scipy.fft.fft(summed, n_fast, axis=1)
    frequency = scipy.fft.fftfreq(n_fast, width)
    order = np.argsort(frequency, kind="stable")
    # The neighbours beyond either end stand for a range narrower than a step.
    step = 1.0 / (n_fast * width)
    order = order[(frequency[order] > slopes[0] - step) & (frequency[order] < slopes[1] + step)]
    power = 2.0 * np.abs(spectrum[:, order]) ** 2 / float((used.count * signal**2).sum() * used.count.sum())
    if power.size == 0:
        return np.zeros((0, DEGREE)), np.zeros(0)
    b, a = _peaks(power)
    return np.column_stack([np.ones(len(a)), frequency[order][a], bends[b]]) @ split, power[b, a]


def _by_fits(
    used: Samples, split: Floats, bends: Floats, phase_per_um: float, ends: tuple[float, float]
) -> tuple[Floats, Floats]:
    """The same of few fringes, which look like a curved offset, by least squares of 1, s, s^2, cos f and sin f."""
    low, high = ends
    if low >= high:
        return np.zeros((0, DEGREE)), np.zeros(0)
    base, slope, bend = (phase_per_um * (legendre(used.s)[:, 1:] @ split.T)).T
    slopes = np.linspace(low, high, max(2, int((high - low) * phase_per_um / 0.8)))
    signal, powers = used.signal - used.signal.mean(), used.s ** np.arange(3)[:, None]
    turned = np.exp(1j * (base + slopes[:, None] * slope))[:, None] * np.exp(1j * bends[:, None] * bend)
    gram, seen = np.empty((*turned.shape[:2], 5, 5)), np.empty((*turned.shape[:2], 5))
    gram[..., :3, :3], seen[..., :3] = used.count * powers @ powers.T, used.count * signal @ powers.T
    crossed, twice = turned @ (used.count * powers).T, turned**2 @ used.count
    gram[..., :3, 3], gram[..., :3, 4] = crossed.real, crossed.imag
    gram[..., 3:, :3] = gram[..., :3, 3:].swapaxes(2, 3)
    gram[..., 3, 3], gram[..., 4, 4] = 0.5 * (used.count.sum() + np.array([twice.real, -twice.real]))
    gram[..., 3, 4] = gram[..., 4, 3] = 0.5 * twice.imag
    at = turned @ (used.count * signal)
    seen[..., 3], seen[..., 4] = at.real, at.imag
    # A tiny ridge keeps a fringe that looks like a parabola solvable.
    gram += np.eye(5) * (1e-6 * gram + 1e-12)
    explained = (seen * np.linalg.solve(gram, seen[..., None])[..., 0]).sum(axis=2)
    explained /= float((used.count * signal**2).sum())
    a, b = _peaks(explained)
    return np.column_stack([np.ones(len(a)), slopes[a], bends[b]]) @ split, explained[a, b]


def _peaks(values: Floats, most: int = 24, least: float = 0.4) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places of the highest local maxima of a table, those above a share of the highest."""
    rows, columns = np.nonzero(values > least * values.max())
    # The first and the last row and column are neighbours of themselves.
    squares = np.lib.stride_tricks.sliding_window_view(np.pad(values, 1, mode="edge"), (3, 3))
    is_peak = values[rows, columns] >= squares[rows, columns].max(axis=(1, 2))
    rows, columns = rows[is_peak], columns[is_peak]
    order = np.argsort(-values[rows, columns])[:most]
    return rows[order], columns[order]


def distinct(profiles: Floats, near: Floats) -> list[int]:
    """Which of profiles (m, degree) are the first within `near` (m,), in um, of themselves or their mirror images."""
    kept: list[int] = []
    for i, each in enumerate(profiles):
        if all(min(np.abs(each - k).max(), np.abs(each + k).max()) > near[i] for k in profiles[kept]):
            kept.append(i)
    return kept
