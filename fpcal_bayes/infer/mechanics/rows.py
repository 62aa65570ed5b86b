"""Rows of a file as the mechanics see them: order, times, and the covariance of what is new in each row."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.fit.noise import Batch, Whitening, group_blocks, reading_errors, whitening_of
from fpcal_bayes.infer.mechanics.marginal import MarginalWhitening
from fpcal_bayes.measure.drive import drive_of_sweeps
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
    made = design(terms, model.vector(values), drive_of_sweeps(sweeps, sizes.minutes_per_sweep), sweeps.sigma)
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


@dataclass(frozen=True)
class RowNoise:
    """What is new in each row: the noise of its readings and the return errors of the joints.

    Attributes
    ----------
    own, common
        Variance of what each row's reading has alone, in um^2, shape (n,), and what it shares with its sweep, in um,
        shape (n, n_common).
    blocks
        Positions of the rows that share their start, one array per sweep with several rows.
    design
        With the return errors.
    """

    own: Floats
    common: Floats
    blocks: tuple[Ints, ...]
    design: Design

    @classmethod
    def of(cls, sweeps: Sweeps, design: Design) -> "RowNoise":
        """Of the rows of a session."""
        return cls(*reading_errors(sweeps), tuple(group_blocks(sweeps)), design)

    @property
    def same_sweep(self) -> Floats:
        """One where two rows share their start, the diagonal included, shape (n, n)."""
        same = np.eye(len(self.own))
        for block in self.blocks:
            same[np.ix_(block, block)] = 1.0
        return same

    def dense(self) -> tuple[Floats, Floats]:
        """Covariances (n, n) of the readings and of the return errors, each at its stated size."""
        same = self.same_sweep
        readings = same * (self.common @ self.common.T)
        readings[np.diag_indices_from(readings)] += self.own
        common = np.hstack([self.design.reached_start, self.design.returned])
        returns = same * (common @ common.T)
        returns[np.diag_indices_from(returns)] += (self.design.reached_end**2).sum(axis=1)
        return readings, returns

    def whitening(self, noise: float = 1.0, returned: float = 1.0) -> Whitening:
        """The map that whitens rows whose readings and return errors are `noise` and `returned` times as stated."""
        common = returned * np.hstack([self.design.reached_start, self.design.returned])
        own = noise**2 * self.own + ((returned * self.design.reached_end) ** 2).sum(axis=1)
        shared = np.column_stack([noise * self.common, common[:, common.any(axis=0)]])
        variance = own + (shared**2).sum(axis=1)
        by_size: dict[int, list[Ints]] = {}
        for block in self.blocks:
            by_size.setdefault(len(block), []).append(block)
        batches = tuple(Batch.of(np.array(rows), np.sqrt(own), shared) for rows in by_size.values())
        return Whitening(1.0 / np.sqrt(variance), batches)

    def draw(self, noise: Floats, returned: Floats, rng: np.random.Generator) -> Floats:
        """Errors of the rows at factors (n_draws,) on readings and return errors, shape (n_draws, n)."""
        n, n_draws = len(self.own), len(noise)
        first = np.arange(n)
        for block in self.blocks:
            first[block] = block[0]
        readings = rng.standard_normal((1 + self.common.shape[1], n_draws, n))
        common = np.hstack([self.design.reached_start, self.design.returned])
        there = common.any(axis=0)
        shared = np.einsum("cdn,nc->dn", readings[1:][..., first], self.common)
        result: Floats = noise[:, None] * (np.sqrt(self.own) * readings[0] + shared)
        if there.any():
            kept = rng.standard_normal((n_draws, n, int(there.sum())))[:, first]
            result += returned[:, None] * (kept * common[:, there]).sum(axis=2)
        ends = np.sqrt((self.design.reached_end**2).sum(axis=1))
        result += returned[:, None] * ends * rng.standard_normal((n_draws, n))
        return result
