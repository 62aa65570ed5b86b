"""The posterior when fringe counts may have slipped: each dL may be off by whole half wavelengths.

From the start of a sweep to its first row, and from each row of a group to the next, a count slips with a probability
eps that is unknown too, by any of 1 to 3 half wavelengths up or down, all equally likely; slips add up along the sweep.
Which rows have slipped is summed over, so that only eps joins the unknowns: as a last one, u, with
logit eps = mean + sd u and u standard normal.
"""

import numpy as np
from scipy import special

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.noise import Batch
from fpcal_bayes.infer.fit.slips import MOST_HALF_WAVES, Slips
from fpcal_bayes.infer.posterior.kernels import slip_sums
from fpcal_bayes.infer.posterior.target import PosteriorTarget

#: Prior of eps: half of it below 4.7 %, 95 % between 0.5 and 34 %.
LOGIT_MEAN, LOGIT_SD = -3.0, 1.2
_NARROWING = 0.6


class SlipTarget(PosteriorTarget):
    """The posterior of rows that may have slipped; charts are those of rows corrected by `slips` that were found."""

    def __init__(self, slips: Slips) -> None:
        super().__init__(slips.problem)
        sweeps = slips.problem.sweeps
        unsigned = np.flatnonzero(~(sweeps.signed | sweeps.absolute))
        if len(unsigned):
            row = int(sweeps.rows[unsigned[0]])
            raise located(sweeps.file, "the slip likelihood needs rows of known sign", row=row, column="signed")
        if len({beam for beam, *_ in slips.problem.rows.parts}) > 1:
            raise located(sweeps.file, "the slip likelihood takes rows of one beam, expected another --likelihood")
        self._half_wave = float(slips.problem.model.half_waves(slips.problem.rows)[0])
        # An absolute length comes from a wavelength scan, not from counting.
        self._can_slip = ~sweeps.absolute
        self._corrected = slips.counts
        self.reference, curvature = _mode(int(np.count_nonzero(slips.counts)), int(self._can_slip.sum()))
        # Proposed a little too widely: the density of u falls off more slowly than a normal one towards few slips.
        self._curvature = _NARROWING * curvature

    @property
    def n_unknowns(self) -> int:
        return super().n_unknowns + 1

    def data_batch(self, points: Floats) -> tuple[Floats, Floats]:
        # The corrected rows, and one that stands for what the data tell about eps.
        residuals, jacobian = super().data_batch(points[:, :-1])
        n_points, n_rows, n = jacobian.shape
        wider = np.zeros((n_points, n_rows + 1, n + 1))
        wider[:, :n_rows, :n] = jacobian
        wider[:, n_rows, n] = self._curvature
        return np.hstack([residuals, self._row_of_eps(points)]), wider

    def data_residuals(self, points: Floats) -> Floats:
        return np.hstack([super().data_residuals(points[:, :-1]), self._row_of_eps(points)])

    def log_density(self, residuals: Floats, points: Floats) -> Floats:
        corrected = residuals[:, : len(self.problem.target)]
        return np.asarray(self._slip_sums(corrected, points)[0] - 0.5 * (points**2).sum(axis=1))

    def _row_log_likelihoods(self, standardised: Floats, points: Floats) -> Floats:
        # Summed over the ways in which a row may have slipped, given those before it in its group.
        result = np.empty_like(standardised)
        for batch in self.problem.whitening.all_batches:
            known = np.zeros((len(points), len(batch.members)))
            for i in range(batch.members.shape[1]):
                total, _ = self._batch_sums(batch, standardised, points, i + 1)
                result[:, batch.members[:, i]] = total - known
                known = total
        return result + self.log_scale

    def slip_probabilities(self, points: Floats) -> Floats:
        """Probability that the count of each row is off, at points (n_points, n_unknowns); shape (n_points, n_rows)."""
        _, stayed = self._slip_sums(self.standardised(points), points)
        return 1.0 - stayed

    def eps(self, points: Floats) -> Floats:
        """Probability of a slip, shape (n_points,)."""
        return special.expit(LOGIT_MEAN + LOGIT_SD * points[..., -1])

    def draw_noise(self, points: Floats, rng: np.random.Generator) -> Floats:
        errors = super().draw_noise(points, rng)
        slipped = (rng.random(errors.shape) < self.eps(points)[:, None]) & self._can_slip
        counts = rng.integers(1, MOST_HALF_WAVES + 1, errors.shape) * rng.choice([-1, 1], errors.shape)
        offsets = np.where(slipped, counts, 0) * self._half_wave
        for batch in self.problem.whitening.batches:
            offsets[:, batch.members] = offsets[:, batch.members].cumsum(axis=2)
        return errors + self.problem.whitening.apply(offsets[:, :, None])[:, :, 0]

    def _repeated(self) -> Floats:
        """The corrections, whitened, shape (n_rows,)."""
        return self.problem.whitening.apply(self._half_wave * self._corrected.astype(float))

    def _row_of_eps(self, points: Floats) -> Floats:
        """A residual whose square, with the prior's, is lowest at the likeliest u; shape (n_points, 1)."""
        return self._curvature * (points[:, -1:] - self.reference) - self.reference / max(self._curvature, 1e-12)

    def _slip_sums(self, corrected: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Log density of all rows (n_points,), and the probability that each has not slipped (n_points, n_rows)."""
        total, stayed = np.zeros(len(points)), np.empty(corrected.shape)
        for batch in self.problem.whitening.all_batches:
            part, known = self._batch_sums(batch, corrected, points, batch.members.shape[1])
            total += part.sum(axis=1)
            stayed[:, batch.members] = known[:, batch.members]
        return total, stayed

    def _batch_sums(self, batch: Batch, corrected: Floats, points: Floats, prefix: int) -> tuple[Floats, Floats]:
        logit, most = LOGIT_MEAN + LOGIT_SD * points[:, -1], MOST_HALF_WAVES
        log_odds = np.array([special.log_expit(logit) - np.log(2.0 * most), special.log_expit(-logit)])
        rows, group = np.ascontiguousarray(corrected), tuple(vars(batch).values())
        return slip_sums(rows, log_odds, self._corrected, self._can_slip, (self._half_wave, most), group, prefix)


def _mode(n_slipped: int, n_rows: int) -> tuple[float, float]:
    """Where u is likeliest if so many rows slipped, and the root of the curvature that the data give there."""
    u = 0.0
    for _ in range(50):
        eps = special.expit(LOGIT_MEAN + LOGIT_SD * u)
        slope = LOGIT_SD * (n_slipped - n_rows * eps) - u
        u += float(np.clip(slope / (LOGIT_SD**2 * n_rows * eps * (1.0 - eps) + 1.0), -1.0, 1.0))
    eps = special.expit(LOGIT_MEAN + LOGIT_SD * u)
    return u, float(LOGIT_SD * np.sqrt(n_rows * eps * (1.0 - eps)))
