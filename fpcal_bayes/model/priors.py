"""Prior distributions of single parameters, as maps from a standard normal score.

A parameter with any of these priors is a monotone function of a score that is standard normal (Wang, Bardsley, Solonen,
Cui, Marzouk 2017): the score's prior row is a unit row, whatever the prior, so that the fit and the sampler know normal
priors only. The maximum that a fit finds is then that of the density of the scores.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import special

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats

_LOG_ROOT_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))


class Marginal(ABC):
    """A prior that is not normal; lengths and angles in internal units (um, rad, 1)."""

    #: As written in a cell's file.
    kind: ClassVar[str]

    @property
    @abstractmethod
    def sd(self) -> float:
        """Standard deviation."""

    @abstractmethod
    def value(self, score: Floats) -> Floats:
        """Values of standard normal scores, same shape."""

    @abstractmethod
    def slope(self, score: Floats) -> Floats:
        """Derivatives of `value`, same shape."""

    @abstractmethod
    def score(self, value: Floats) -> Floats:
        """Scores of values, same shape; `InputError` if the prior excludes one."""

    def settings(self) -> list[float]:
        """The numbers that define it, for the cell's hash."""
        return list(vars(self).values())


@dataclass(frozen=True)
class TruncatedNormal(Marginal):
    """A normal distribution cut off at `low` and `high`, which may be infinite; half-normal: cut off at its centre."""

    centre: float
    spread: float
    low: float
    high: float
    kind: ClassVar[str] = "truncated-normal"

    def __post_init__(self) -> None:
        if not (self.spread > 0 and self.low <= self.centre <= self.high and self.low < self.high):
            raise InputError("a truncated normal prior: expected a spread above zero and low <= nominal <= high")

    @property
    def _ends(self) -> tuple[float, float]:
        return (self.low - self.centre) / self.spread, (self.high - self.centre) / self.spread

    @property
    def _mass(self) -> float:
        low, high = self._ends
        return float(special.ndtr(high) - special.ndtr(low))

    @property
    def sd(self) -> float:
        low, high = self._ends
        at = [0.0 if np.isinf(end) else float(np.exp(-0.5 * end**2 - _LOG_ROOT_TWO_PI)) for end in (low, high)]
        ends = [0.0 if np.isinf(end) else end for end in (low, high)]
        mean = (at[0] - at[1]) / self._mass
        return self.spread * float(np.sqrt(1.0 + (ends[0] * at[0] - ends[1] * at[1]) / self._mass - mean**2))

    def value(self, score: Floats) -> Floats:
        return self.centre + self.spread * self._deviate(score)

    def slope(self, score: Floats) -> Floats:
        return np.asarray(self.spread * self._mass * np.exp(0.5 * (self._deviate(score) ** 2 - score**2)))

    def score(self, value: Floats) -> Floats:
        _require_inside(value, self.low, self.high)
        low, high = self._ends
        deviate = (value - self.centre) / self.spread
        below = (special.ndtr(deviate) - special.ndtr(low)) / self._mass
        return _smaller_tail(below, (special.ndtr(-deviate) - special.ndtr(-high)) / self._mass)

    def settings(self) -> list[float]:
        return [self.centre, self.spread, *self._ends]

    def _deviate(self, score: Floats) -> Floats:
        """Standardised values; each tail is computed from its own end, where the other has no digits left."""
        low, high = self._ends
        below = special.ndtr(low) + self._mass * special.ndtr(score)
        return np.clip(_smaller_tail(below, special.ndtr(-high) + self._mass * special.ndtr(-score)), low, high)


@dataclass(frozen=True)
class Uniform(Marginal):
    """All values between `low` and `high` equally likely."""

    low: float
    high: float
    kind: ClassVar[str] = "uniform"

    def __post_init__(self) -> None:
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise InputError("a uniform prior: expected low < high, both finite")

    @property
    def sd(self) -> float:
        return (self.high - self.low) / float(np.sqrt(12.0))

    def value(self, score: Floats) -> Floats:
        width = self.high - self.low
        return np.where(score < 0, self.low + width * special.ndtr(score), self.high - width * special.ndtr(-score))

    def slope(self, score: Floats) -> Floats:
        return np.asarray((self.high - self.low) * np.exp(-0.5 * score**2 - _LOG_ROOT_TWO_PI))

    def score(self, value: Floats) -> Floats:
        _require_inside(value, self.low, self.high)
        width = self.high - self.low
        return _smaller_tail((value - self.low) / width, (self.high - value) / width)


@dataclass(frozen=True)
class LogNormal(Marginal):
    """Positive values whose logarithm is normal: `median`, and the `factor` of one standard deviation."""

    median: float
    factor: float
    kind: ClassVar[str] = "log-normal"

    def __post_init__(self) -> None:
        if not (self.median > 0 and 1 < self.factor < np.inf):
            raise InputError("a log-normal prior: expected a nominal value above zero and a factor above one")

    @property
    def _log_factor(self) -> float:
        return float(np.log(self.factor))

    @property
    def sd(self) -> float:
        variance = self._log_factor**2
        return self.median * float(np.exp(variance / 2.0) * np.sqrt(np.expm1(variance)))

    def value(self, score: Floats) -> Floats:
        return np.asarray(self.median * np.exp(self._log_factor * score))

    def slope(self, score: Floats) -> Floats:
        return self._log_factor * self.value(score)

    def score(self, value: Floats) -> Floats:
        if not (value > 0).all():
            raise InputError("a value outside its prior's limits, which are above zero")
        return np.asarray(np.log(value / self.median) / self._log_factor)


def _require_inside(value: Floats, low: float, high: float) -> None:
    if not ((value > low) & (value < high)).all():
        raise InputError(f"a value outside its prior's limits, {low:g} to {high:g} (um or rad)")


def _smaller_tail(below: Floats, above: Floats) -> Floats:
    """Normal deviates of probabilities `below`, computed from whichever tail is smaller."""
    return np.where(below < above, special.ndtri(below), -special.ndtri(above))
