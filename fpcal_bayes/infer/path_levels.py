"""Mean and height of the fringes along a path, and how well the reference scans tell them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.measure.fringe_reference import FringeFit

Floats = NDArray[np.float64]

#: How mean and amplitude may bow between two reference scans that agree, relative, one standard deviation, unless told:
#: laser power and detector are stable to half a percent in ten seconds. Where the scans differ, as much is added.
STABILITY = 5e-3
#: Their relative drift where there is no second scan.
_UNKNOWN_DRIFT = 1e-2


@dataclass(frozen=True, eq=False)
class Levels:
    """Mean and height of the fringes, between a reference scan before a path and, where there is one, one after it.

    Attributes
    ----------
    first, last
        The reference scans; `last` may be None.
    share
        How far the samples of the path stand between the scans in time, shape (n,).
    lift
        By how much the mean rises for a volt of amplitude, since the mirror moves and tilts, shape (n,).
    ratio
        Amplitude relative to that of the first scan's place, shape (n,).
    stability
        How mean and amplitude may bow between the scans, relative, one standard deviation.
    """

    first: FringeFit
    last: FringeFit | None
    share: Floats
    lift: Floats
    ratio: Floats
    stability: float = STABILITY

    def prior(self) -> tuple[Floats, Floats]:
        """Expected nuisances and their covariance: mean and amplitude at either end, phase, bows of mean and amplitude.

        Returns
        -------
        tuple of ndarray
            Shapes (7,) and (7, 7), in V and rad.
        """
        first, last = self.first, self.last
        turn = np.array(
            [
                [1.0, 0.0, 0.0],
                [0.0, np.cos(first.phase), np.sin(first.phase)],
                [0.0, -np.sin(first.phase) / first.amplitude, np.cos(first.phase) / first.amplitude],
            ]
        )
        begin = turn @ first.covariance @ turn.T
        expected = np.array([first.mean, first.amplitude, first.mean, first.amplitude, first.phase, 0.0, 0.0])
        covariance = np.zeros((7, 7))
        at = [0, 1, 4]
        covariance[np.ix_(at, at)] = begin
        if last is None:
            drift = _UNKNOWN_DRIFT * np.array([first.mean, first.amplitude])
            covariance[[2, 3], [2, 3]] = begin[[0, 1], [0, 1]] + drift**2
        else:
            expected[2], expected[3] = last.mean, last.amplitude / self.ratio[-1]
            covariance[[2, 3], [2, 3]] = last.covariance[0, 0], last.covariance[1, 1] / self.ratio[-1] ** 2
        change = expected[2:4] - expected[:2]
        covariance[[5, 6], [5, 6]] = change**2 / 2.0 + (self.stability * expected[:2]) ** 2
        return expected, covariance

    def weights(self) -> tuple[Floats, Floats]:
        """How mean and amplitude follow from the nuisances but the phase: two matrices, each of shape (n, 7)."""
        bow, none = 4.0 * self.share * (1.0 - self.share), np.zeros_like(self.share)
        mean = np.column_stack([1.0 - self.share, none, self.share, none, none, bow, none])
        amplitude = np.column_stack([none, 1.0 - self.share, none, self.share, none, none, bow])
        return mean + self.lift[:, None] * amplitude, self.ratio[:, None] * amplitude
