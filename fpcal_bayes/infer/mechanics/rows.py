"""Rows of a file as the mechanics see them: order, times, and the covariance of what is new in each row."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.infer.fit.noise import Whitening, shared_whitening, whitening_of
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.measure.sharing import Sharing, drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.mechanics import Design, Terms, design


def row_whitening(model: CavityModel, sweeps: Sweeps, values: Floats, log_scales: Floats | None = None) -> Whitening:
    """Whitening of the rows of one session at free parameters `values` (n,), with the cell's mechanics marginalised.

    `log_scales` (n_scales,) are logarithms of factors on the stated sizes, by default zero. A cell without mechanics
    has the noise of its readings and the repeatability of its joints.
    """
    sizes = model.cell.mechanics
    if sizes is None:
        return with_scale(whitening_of(model, sweeps, values), sweeps)
    terms = Terms.of(model.cell, sizes, model.free.names)
    drive = drive_of_sweeps(sweeps, sizes.minutes_per_sweep, terms.still)
    made = design(terms, model.vector(values), drive, sweeps.sigma)
    log = np.zeros(len(terms.scales)) if log_scales is None else log_scales
    return scaled_whitening(RowNoise.of(sweeps, made), made, log)


def with_scale(base: Whitening, sweeps: Sweeps) -> Whitening:
    """The whitening of rows of which `base` does not know that they share a scale of all lengths."""
    return MarginalWhitening.around(base, sweeps.scaled[:, None]) if sweeps.scaled.any() else base


def scaled_whitening(noise: "RowNoise", made: Design, log: Floats) -> MarginalWhitening:
    """The whitening of rows with the mechanics marginalised at scales exp(log)."""
    factors = np.exp(log)
    base = noise.whitening(float(factors[-1]), float(factors[-2]))
    return MarginalWhitening.around(base, made.matrix * factors[made.scale])


@dataclass(frozen=True, repr=False)
class RowNoise(Brief):
    """What is new in each row: the noise of its readings and the return errors of the joints."""

    sigma: Floats  # stated standard deviation of the rows' readings in um, shape (n,)
    stated: Floats  # what rows say that they share with their sweep beside it, in um, shape (n, n_stated)
    absolute: Bools  # rows that have no start, shape (n,)
    sharing: Sharing  # which rows share a start, and which an end
    design: Design  # with the return errors

    @classmethod
    def of(cls, sweeps: Sweeps, design: Design) -> "RowNoise":
        """Of the rows of a session."""
        return cls(sweeps.sigma, sweeps.common, sweeps.absolute, Sharing.of(sweeps), design)

    def dense(self) -> tuple[Floats, Floats]:
        """Covariances (n, n) of the readings and of the return errors, each at its stated size."""
        firsts = (self.sharing.reading, self.sharing.start, self.sharing.end)
        alike, same, moment = (first[:, None] == first for first in firsts)
        halved = np.where(self.stated.any(axis=1), 0.0, self.sigma)
        readings = 0.5 * alike * np.outer(halved, halved)
        readings[np.diag_indices_from(readings)] = self.sigma**2
        readings += alike * (self.stated @ self.stated.T)
        common, ends = np.hstack([self.design.reached_start, self.design.returned]), self.design.reached_end
        returns = same * (common @ common.T)
        if self.sharing.several:
            returns += moment * (ends @ ends.T)
        else:
            returns[np.diag_indices_from(returns)] += (ends**2).sum(axis=1)
        return readings, returns

    def whitening(self, noise: float = 1.0, returned: float = 1.0) -> Whitening:
        """The map that whitens rows whose readings and return errors are `noise` and `returned` times as stated."""
        common = returned * np.hstack([self.design.reached_start, self.design.returned])
        ends = returned * self.design.reached_end
        return shared_whitening(self.sharing, noise * self.sigma, self.absolute, common, ends, noise * self.stated)

    def draw(self, noise: Floats, returned: Floats, rng: np.random.Generator) -> Floats:
        """Errors of the rows at factors (n_draws,) on readings and return errors, shape (n_draws, n)."""
        n, n_draws = len(self.sigma), len(noise)
        readings = rng.standard_normal((2, n_draws, n))
        common = np.hstack([self.design.reached_start, self.design.returned])
        there = common.any(axis=0)
        alone = self.stated.any(axis=1)
        shared = np.where(alone, np.sqrt(2.0) * readings[0], readings[0] + readings[1][:, self.sharing.reading])
        result: Floats = noise[:, None] * self.sigma / np.sqrt(2.0) * shared
        if alone.any():
            drawn = rng.standard_normal((n_draws, *self.stated.shape))[:, self.sharing.reading]
            result += noise[:, None] * (drawn * self.stated).sum(axis=2)
        if there.any():
            kept = rng.standard_normal((n_draws, n, int(there.sum())))[:, self.sharing.start]
            result += returned[:, None] * (kept * common[:, there]).sum(axis=2)
        ends = self.design.reached_end
        if self.sharing.several:
            missed = rng.standard_normal((n_draws, *ends.shape))[:, self.sharing.end]
            return result + returned[:, None] * (missed * ends).sum(axis=2)
        result += returned[:, None] * np.sqrt((ends**2).sum(axis=1)) * rng.standard_normal((n_draws, n))
        return result
