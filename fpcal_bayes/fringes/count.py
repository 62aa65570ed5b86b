"""The reading of a trace: which of the possible ones it is, and whether that may be said.

A photodiode alone tells L only up to its mirror image, and now and then up to some fringes. Witnesses (wavelength scans
before and after, an estimate, the cell's priors) say what change to expect; all of it is weighed together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.fit import Fit
from fpcal_bayes.fringes.profile import legendre

#: Probability of another count, or of the other sign, from which on a reading does not stand.
_COUNT_RISK, _SIGN_RISK = 1e-3, 1e-4
#: A sign_source may be wrong altogether with this probability: it then expects anything within the last column, in um.
_WITNESS_LIES, _ANYTHING = 1e-6, 200.0
#: Odds of a late start, or of an early stop, of a trace alone; shares of its traces in which a stage may have one.
ALONE = 0.003
_RATES = np.arange(0.005, 1.0, 0.01)
#: Changes closer than this, in um, are one count.
_SAME_COUNT = 0.1


@dataclass(frozen=True)
class Reading:
    """The change of cavity length along one sweep, and how far to trust it."""

    label: str  # of the sweep
    dl: float = np.nan  # change from start to end, in um; NaN where the trace was refused
    sigma: float = np.nan  # its standard deviation, in um
    signed: bool = False  # whether the sign of `dl` is known; else `dl` is a size
    sign_source: str = ""  # who told the sign, or empty
    fringes: float = np.nan  # that passed, those that passed back included
    turns: tuple[float, ...] = ()  # places s on the sweep, from -1 to 1, at which L turns
    reversals: tuple[float, ...] = ()  # joint positions of the same, in um or rad
    set_out: float = -1.0  # place at which the mirror set out
    stop: float = 1.0  # place at which it stopped
    late: float = 0.0  # how far the joint moved without it, in um or rad
    uneven: bool = False  # whether it left the joint's course between them
    refused: str = ""  # why the trace gives no number at all; empty where it gives one
    doubt: str = ""  # why the number is not to be relied on; empty where it is
    strayed: bool = False  # whether that is what the mirror did, or the light
    alternatives: tuple[float, ...] = ()  # other changes, in um, that the trace allows
    samples_a_fringe: float = np.nan  # on average, while the joint moves
    noise: float = np.nan  # standard deviation of one sample, in V
    amplitude: float = np.nan  # of the fringes, on average, in V
    #: profile, profile_covariance: L less its mean along the sweep, with the sign of `dl`: Legendre coefficients in um,
    #: see `DisplacementProfile`.
    profile: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    profile_covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    #: Relative standard deviation of wavelength over index, which scales the lengths of all traces alike; part of
    #: `sigma` where the sign is not known.
    wavelength_share: float = 0.0
    fit: Fit | None = field(default=None, repr=False)  # what was fitted, for figures; None where refused
    phase_per_um: float = np.nan  # 4 pi n / wavelength

    @property
    def good(self) -> bool:
        """Whether the number may be used."""
        return not self.refused and not self.doubt

    @property
    def scale_ppm(self) -> Floats:
        """The same in ppm where it is no part of `sigma`, else NaN, shape (1,)."""
        return np.array([1e6 * self.wavelength_share if self.signed and self.wavelength_share else np.nan])

    def changes(self, s: Floats) -> tuple[Floats, Floats]:
        """Changes of L in um (n,) from the start to places `s` (n,) from -1 to 1, with their full covariance (n, n)."""
        degree = len(self.profile)
        places = np.clip(s, self.set_out, self.stop)
        rows = (legendre(places, degree) - legendre(np.array([self.set_out]), degree))[:, 1:]
        changes = rows @ self.profile
        scaled = np.zeros_like(changes) if self.signed else self.wavelength_share * changes
        covariance = rows @ self.profile_covariance @ rows.T + np.outer(scaled, scaled)
        # Where the mirror was at the start is common to all changes.
        return changes, covariance + (0.0 if self.fit is None else self.fit.ends_variance)

    def grouped(self, points: int) -> tuple[Floats, Floats, float]:
        """Places (points + 1,), changes there in um, and the least sd in um that does not claim more than is known."""
        s = np.linspace(-1.0, 1.0, points + 2)[1:]
        changes, covariance = self.changes(s)
        root = np.linalg.inv(np.linalg.cholesky(0.5 * (np.eye(len(s)) + 1.0)))
        return s, changes, float(np.sqrt(max(np.linalg.eigvalsh(root @ covariance @ root.T)[-1], self.sigma**2)))


@dataclass(frozen=True)
class SignSource:
    """A change of length that somebody expects: in um, with its standard deviation, and who says so."""

    dl: float
    sd: float
    source: str

    def log_likelihood(self, dl: Floats, sd: Floats) -> Floats:
        """Log likelihood of changes `dl` known to `sd`; both of shape (n,)."""
        spread = np.hypot(self.sd, sd)
        z = np.minimum(np.abs(dl - self.dl) / spread, 1e6)
        honest = np.log1p(-_WITNESS_LIES) - 0.5 * z**2 - np.log(spread * np.sqrt(2.0 * np.pi))
        return np.asarray(np.logaddexp(honest, np.log(_WITNESS_LIES / (2.0 * _ANYTHING))))


@dataclass(frozen=True)
class CountDecision:
    """What a trace is taken to say."""

    fit: Fit  # the fit chosen
    mirrored: bool  # whether L runs opposite to `fit`
    signed: bool  # whether the sign is certain enough to be stated
    sign_source: str  # who told the sign; empty where nobody did
    other_counts: float  # probability that L changed by another number of fringes
    alternatives: tuple[float, ...]  # changes in um that this probability falls to, the most likely first

    @property
    def doubtful(self) -> bool:
        """Whether the count is too uncertain to be used."""
        return self.other_counts > _COUNT_RISK


def decide(fits: Sequence[Fit], sign_sources: Sequence[SignSource]) -> CountDecision:
    """Weigh distinct fits of one trace and their mirror images; the first source that tells the sign alone is named."""
    dl, sd = np.array([fit.change for fit in fits]).T
    both, sds = np.concatenate([dl, -dl]), np.concatenate([sd, sd])
    weights = np.tile([fit.evidence for fit in fits], 2)
    for sign_source in sign_sources:
        weights = weights + sign_source.log_likelihood(both, sds)
    share = np.exp(weights - weights.max())
    share /= share.sum()
    chosen = int(np.argmax(share))
    size = np.abs(both)
    same = np.abs(size - size[chosen]) < _SAME_COUNT
    opposite = float(share[same & (np.sign(both) != np.sign(both[chosen]))].sum())
    signed = bool(opposite < _SIGN_RISK * share[same].sum())
    pair = both[chosen] * np.array([-1.0, 1.0]), np.full(2, sds[chosen])
    tellers = [s.source for s in sign_sources if np.diff(s.log_likelihood(*pair))[0] > -np.log(_SIGN_RISK)]
    others = np.flatnonzero(~same & (share > 1e-6))
    others = others[np.argsort(-share[others])]
    alternatives = list(dict.fromkeys(float(both[i]) if signed else float(size[i]) for i in others))
    return CountDecision(
        fit=fits[chosen % len(fits)],
        mirrored=chosen >= len(fits),
        signed=signed,
        sign_source=(*tellers, "several together")[0] if signed else "",
        other_counts=float(share[~same].sum()),
        alternatives=tuple(alternatives[:4]),
    )


def shared_odds(ratios: Floats, joints: Ints) -> Floats:
    """Odds (n, k) of k defects in n traces by the others, from ratios (n, k) of likelihoods with and without them.

    A joint, of `joints` (n,), has a defect never, or in any share of its traces alike. NaN: a trace tells nothing.
    """
    known = np.where(np.isnan(ratios), 1.0, np.minimum(ratios, 1e30))
    logs = np.log1p(np.append(0.0, _RATES)[:, None, None] * (known - 1.0))
    others = np.tensordot(logs, joints[:, None] == joints, (1, 0)).transpose(0, 2, 1) - logs
    others[0] += np.log(len(_RATES) * (0.5 / ALONE - 0.5))
    weights = np.exp(others - others.max(axis=0))
    rate = np.tensordot(_RATES, weights[1:], 1) / weights.sum(axis=0)
    return np.asarray(rate / (1.0 - rate))
