"""What a fit leaves of a signal's phase, block by block: whether the model holds, and what else may explain it.

Noise averages out over a block of samples; a mirror that sets out late or a laser that hops does not. Each block tells
by how much the phase is off, and the noise is that from sample to sample, so that nothing which all traces share counts
as noise.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.fit import Fit, damping
from fpcal_bayes.fringes.profile import legendre
from fpcal_bayes.fringes.samples import Samples

#: Blocks of a trace; the first and the last are halved this many times more towards the ends, where mirrors linger.
_BLOCKS, _HALVINGS = 24, 5
_ENDS = 2.0 ** -np.arange(_HALVINGS, -1.0, -1.0) / _BLOCKS
_EDGES = np.concatenate([[0.0], _ENDS, np.arange(2, _BLOCKS - 1) / _BLOCKS, 1.0 - _ENDS[::-1], [1.0]])
#: Samples in a row that a jump of the light spoils beyond what a course follows.
_IN_A_ROW = 8
#: Odds that a scan is straight.
_STRAIGHT = 20.0
#: Rounds in which a block's phase is sought, until none changes by more than this, in rad.
_ROUNDS, _SMALL = 5, 0.02
#: Periods of a ripple that are tried, in a scan.
_RIPPLES = np.arange(1.0, 11.0, 0.25)
#: Swings of a signal count as fringes beyond this share of its half range to either side.
_SWING = 0.35


@dataclass(frozen=True)
class PhaseErrors:
    """Phase that a fit misses in each block of a trace."""

    s: Floats  # middle of each block, (n_blocks,)
    phase: Floats  # rad, (n_blocks,)
    sd: Floats  # of each by the noise from sample to sample, rad, (n_blocks,)
    worst: float  # largest mean square of what is left of a few samples in a row, by that noise

    @classmethod
    def of(cls, fit: Fit, samples: Samples, phase_per_um: float) -> "PhaseErrors":
        """Errors of a fit of `samples`."""
        root, turn = np.sqrt(samples.count), np.zeros(len(samples))
        edges = np.unique(np.rint(len(samples) * _EDGES).astype(np.int64))
        sizes, total = np.diff(edges), np.zeros(len(edges) - 1)
        level, height = fit.levels(samples.s, samples.time)
        signal, phase = root * (samples.signal - level), fit.phase(samples.s, phase_per_um)
        height *= root * damping(fit.profile, samples.s, samples.spread, phase_per_um)
        for _ in range(_ROUNDS):
            wave, slope = fit.wave(phase + turn)
            left, slope = signal - height * wave, height * slope
            weight = np.add.reduceat(slope**2, edges[:-1]) + 1e-12
            found = np.clip(np.add.reduceat(left * slope, edges[:-1]) / weight, -1.0, 1.0)
            total, turn = total + found, turn + np.repeat(found, sizes)
            if (np.abs(found) < _SMALL + 3.0 * np.sqrt(np.mean(left**2) / weight)).all():
                break
        noise = max(float(np.sqrt(np.mean(np.diff(left) ** 2) / 2.0)), 1e-9 * fit.amplitude)
        # At the tops alone a block tells nothing of its phase.
        told = weight > 0.02 * sizes * float(np.mean(slope**2))
        middle = np.add.reduceat(samples.s, edges[:-1]) / sizes
        worst = float(uniform_filter1d((left / noise) ** 2, _IN_A_ROW).max())
        return cls(middle[told], total[told], noise / np.sqrt(weight[told]), worst)

    @property
    def scores(self) -> Floats:
        """Errors in standard deviations."""
        return self.phase / self.sd

    @property
    def excess(self) -> float:
        """Mean square of the scores: about one for a model that holds."""
        return float(np.mean(self.scores**2))

    @property
    def probability(self) -> float:
        """That noise alone leaves as much."""
        return chi2_tail(float(self.scores @ self.scores), len(self.s))

    def straightened(self, stretch: float) -> tuple[float, float, float]:
        """A line's slope (rad per unit of s) beside a hop, a ripple or a bow that may explain the errors of a scan.

        stretch: half the range of 1 / wavelength over its middle, by whose square its error turns the phase. Returns
        slope and sd of all explanations averaged (Schwarz's criterion), and the mean square that the best leaves.
        """
        s, line, felt = self.s, legendre(self.s, 3), (1.0 + stretch * self.s) ** 2
        # Either side of a hop may be the one that is told right; its own block is left out by a number of its own.
        sides = [(at, side) for at in s[1:-1] for side in (s > at, s < at)]
        others = [np.array([felt * side, s == at]) for at, side in sides]
        others += [felt * np.array([np.sin(turn), np.cos(turn)]) for turn in np.pi * np.outer(_RIPPLES, s)]
        nothing = np.zeros_like(s)
        beside = np.array([[nothing, nothing], *others, [line[:, 2], nothing], [line[:, 2], line[:, 3]]])
        scaled = np.concatenate([np.broadcast_to(line[:, :2].T, (len(beside), 2, len(s))), beside], axis=1) / self.sd
        size = np.einsum("mij,mij->mi", scaled, scaled)
        count = (size > 0.0).sum(axis=1)
        gram = scaled @ scaled.transpose(0, 2, 1) + (1e-10 * size + (size == 0.0))[:, :, None] * np.eye(4)
        covariance = np.linalg.inv(gram)
        answer = (covariance @ (scaled @ self.scores)[..., None])[..., 0]
        left = ((self.scores - np.einsum("mi,mij->mj", answer, scaled)) ** 2).sum(axis=1)
        slope, variance, rest = answer[:, 1], covariance[:, 1, 1], left / (len(s) - count)
        factor = max(1.0, float(rest[np.argmin(left + count * np.log(len(s)))]))
        # A line alone is as likely beforehand as this many times all its rivals together.
        score = left / factor + count * np.log(len(s))
        score[1:] += 2.0 * np.log(_STRAIGHT * len(left))
        share = np.exp(-0.5 * (score - score.min()))
        share /= share.sum()
        mean = float(share @ slope)
        return mean, float(np.sqrt(share @ (factor * variance + (slope - mean) ** 2))), factor


def fringes_seen(samples: Samples) -> float:
    """Fringes that pass in a signal, by its swings alone; zero where it is noise."""
    left = samples.levelled()
    if np.std(np.diff(left)) > np.std(left):
        return 0.0
    low, high = np.quantile(left, (0.02, 0.98))
    side = np.where(left > _SWING * high, 1, np.where(left < _SWING * low, -1, 0))
    return float((np.diff(side[side != 0]) != 0).sum()) / 2.0
