"""Which of the possible readings of a trace it is, and whether that may be said.

A photodiode alone tells L only up to its mirror image, and now and then up to some fringes. Witnesses (wavelength scans
before and after, an estimate, the cell's priors) say what change to expect; all of it is weighed together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.measure.fringes.fit import Fit
from fpcal_bayes.measure.fringes.solve import change_of

Floats = NDArray[np.float64]

#: Probability of another count, or of the other sign, from which on a reading does not stand.
_COUNT_RISK, _SIGN_RISK = 1e-3, 1e-4
#: A witness may be wrong altogether with this probability: it then expects anything within the last column, in um.
_WITNESS_LIES, _ANYTHING = 1e-6, 200.0
#: Changes closer than this, in um, are one count.
_SAME_COUNT = 0.1


@dataclass(frozen=True)
class Witness:
    """A change of length that somebody expects: in um, with its standard deviation, and who says so."""

    dl: float
    sd: float
    source: str

    def log_likelihood(self, dl: Floats, sd: Floats) -> Floats:
        """Of changes `dl` known to `sd`; both of shape (n,)."""
        spread = np.hypot(self.sd, sd)
        z = np.minimum(np.abs(dl - self.dl) / spread, 1e6)
        honest = np.log1p(-_WITNESS_LIES) - 0.5 * z**2 - np.log(spread * np.sqrt(2.0 * np.pi))
        return np.asarray(np.logaddexp(honest, np.log(_WITNESS_LIES / (2.0 * _ANYTHING))))


@dataclass(frozen=True)
class Verdict:
    """What a trace is taken to say.

    Attributes
    ----------
    fit
        The fit chosen.
    mirrored
        Whether L runs opposite to `fit`.
    signed
        Whether the sign is certain enough to be stated.
    sign_source
        Who told the sign; empty where nobody did.
    other_counts
        Probability that L changed by another number of fringes.
    alternatives
        Changes in um that this probability falls to, the most likely first.
    """

    fit: Fit
    mirrored: bool
    signed: bool
    sign_source: str
    other_counts: float
    alternatives: tuple[float, ...]

    @property
    def doubtful(self) -> bool:
        """Whether the count is too uncertain to be used."""
        return self.other_counts > _COUNT_RISK


def decide(fits: Sequence[Fit], witnesses: Sequence[Witness]) -> Verdict:
    """Weigh fits and their mirror images.

    Parameters
    ----------
    fits
        Distinct courses of one trace.
    witnesses
        The most trustworthy first; the first that tells the sign by itself is named as its source.
    """
    dl, sd = np.array([change_of(fit) for fit in fits]).T
    both, sds = np.concatenate([dl, -dl]), np.concatenate([sd, sd])
    weights = np.tile([fit.evidence for fit in fits], 2)
    for witness in witnesses:
        weights = weights + witness.log_likelihood(both, sds)
    share = np.exp(weights - weights.max())
    share /= share.sum()
    chosen = int(np.argmax(share))
    size = np.abs(both)
    same = np.abs(size - size[chosen]) < _SAME_COUNT
    opposite = float(share[same & (np.sign(both) != np.sign(both[chosen]))].sum())
    signed = bool(opposite < _SIGN_RISK * share[same].sum())
    others = np.flatnonzero(~same & (share > 1e-6))
    others = others[np.argsort(-share[others])]
    alternatives = list(dict.fromkeys(float(both[i]) if signed else float(size[i]) for i in others))
    return Verdict(
        fit=fits[chosen % len(fits)],
        mirrored=chosen >= len(fits),
        signed=signed,
        sign_source=_teller(witnesses, both[chosen], sds[chosen]) if signed else "",
        other_counts=float(share[~same].sum()),
        alternatives=tuple(alternatives[:4]),
    )


def _teller(witnesses: Sequence[Witness], dl: float, sd: float) -> str:
    for witness in witnesses:
        right, wrong = witness.log_likelihood(np.array([dl, -dl]), np.array([sd, sd]))
        if right - wrong > -np.log(_SIGN_RISK):
            return witness.source
    return "several together"
