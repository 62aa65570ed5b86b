"""The covariance of the measured rows, and the whitening that makes them independent with unit variance."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve_triangular

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.infer.fit.kernels import whiten_groups
from fpcal_bayes.measure.sharing import Sharing
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel


@dataclass(frozen=True)
class Batch:
    """Groups of equally many rows, each row whitened given those before it in its group.

    In units of its own error a row is ``shared @ z`` plus that error, z common to the group, of unit variance. What
    earlier rows tell of z is taken off (a Kalman filter on z): the inverse Cholesky factor, without forming it.
    """

    members: Ints  # positions of the rows, shape (n_groups, n_members)
    own: Floats  # one over the standard deviation of each row's own error, same shape
    shared: Floats  # effect of the common errors on each row, shape (n_groups, n_members, n_common)
    gain: Floats  # times the sum over earlier rows of `shared` times the row: the prediction of a row
    scale: Floats  # one over the standard deviation of what is left, shape (n_groups, n_members)

    @classmethod
    def of(cls, members: Ints, own_sd: Floats, common: Floats) -> "Batch":
        """From own errors (n_rows,) and common ones (n_rows, n_common), both of all rows."""
        own = 1.0 / own_sd[members]
        shared = common[members] * own[..., None]
        products = shared[..., :, None] * shared[..., None, :]
        known = np.eye(shared.shape[-1]) + np.cumsum(np.pad(products[:, :-1], ((0, 0), (1, 0), (0, 0), (0, 0))), axis=1)
        gain = np.linalg.solve(known, shared[..., None])[..., 0]
        return cls(members, own, shared, gain, 1.0 / np.sqrt(1.0 + (shared * gain).sum(axis=-1)))

    def apply(self, rows: Floats) -> None:
        """Whiten the members among the rows (n_points, n_rows, n) in place."""
        whiten_groups(rows, *vars(self).values())

    def weigh(self, rows: Floats, result: Floats) -> None:
        """Multiply the members among the entries of a vector (n_rows,) by the groups' inverse covariance."""
        scaled = rows[self.members] * self.own
        seen = (self.shared * scaled[..., None]).sum(axis=1)
        known = np.eye(self.shared.shape[-1]) + self.shared.transpose(0, 2, 1) @ self.shared
        common = (self.shared @ np.linalg.solve(known, seen[..., None]))[..., 0]
        result[self.members] = (scaled - common) * self.own

    def entries(self) -> tuple[Floats, Ints, Ints]:
        """Lower triangles of the groups' inverse Cholesky factors: values, rows, columns."""
        count = self.members.shape[1]
        factor = np.tril(-self.gain @ self.shared.transpose(0, 2, 1), -1) + np.eye(count)
        factor *= self.scale[:, :, None] * self.own[:, None, :]
        row, column = np.tril_indices(count)
        return factor[:, row, column].ravel(), self.members[:, row].ravel(), self.members[:, column].ravel()


@dataclass(frozen=True, repr=False)
class Whitening(Brief):
    """Linear map under which the rows have unit covariance."""

    scale: Floats  # one over the standard deviation of each row, shape (n_rows,)
    batches: tuple[Batch, ...] = ()  # what replaces `scale` where rows share a reading

    @property
    def as_matrix(self) -> Any:
        """The map as a sparse matrix (n_rows, n_rows)."""
        return sparse.diags_array(self.scale) if self.mix is None else self.mix

    @property
    def only_scales(self) -> bool:
        """Whether every row is whitened by itself."""
        return not self.batches

    @property
    def variance(self) -> Floats:
        """Variance of each row in um^2, shape (n_rows,)."""
        return self.scale**-2

    @property
    def log_volume(self) -> float:
        """Logarithm of the factor by which the map stretches the space of the rows."""
        diagonal = self.scale.copy()
        for batch in self.batches:
            diagonal[batch.members] = batch.scale * batch.own
        return float(np.log(diagonal).sum())

    def apply(self, rows: Floats) -> Floats:
        """Whiten a vector (n_rows,), the columns of a matrix (n_rows, n), or of many (n_points, n_rows, n)."""
        if not self.batches:
            return rows * (self.scale if rows.ndim == 1 else self.scale[:, None])
        result = np.array(rows, dtype=float, order="C")
        stacked = result.reshape((1,) * (3 - rows.ndim) + rows.shape) if rows.ndim > 1 else result.reshape(1, -1, 1)
        stacked[:, self._alone] *= self.scale[self._alone, None]
        for batch in self.batches:
            batch.apply(stacked)
        return result

    @cached_property
    def all_batches(self) -> tuple[Batch, ...]:
        """The batches, rows that share nothing being groups of one."""
        alone = self._alone[:, None]
        nothing = np.zeros((*alone.shape, 1))
        rest = [Batch(alone, self.scale[alone], nothing, nothing, np.ones(alone.shape))] if len(alone) else []
        return (*self.batches, *rest)

    @cached_property
    def _alone(self) -> Ints:
        """Positions of the rows that share nothing."""
        grouped = [batch.members.ravel() for batch in self.batches]
        return np.setdiff1d(np.arange(len(self.scale)), np.concatenate([*grouped, np.zeros(0, dtype=np.int64)]))

    def scaled(self, factor: float) -> "Whitening":
        """The whitening of rows whose errors are `factor` times as large."""
        return Whitening(self.scale / factor, tuple(replace(batch, own=batch.own / factor) for batch in self.batches))

    def unwhiten(self, rows: Floats) -> Floats:
        """Undo `apply` on the columns of a matrix (n_rows, n)."""
        if self.mix is None:
            return rows / self.scale[:, None]
        return np.asarray(spsolve_triangular(self.mix, rows, lower=True))

    def weigh(self, rows: Floats) -> Floats:
        """Multiply a vector (n_rows,) by the inverse covariance: the transposed map of the whitened vector."""
        result: Floats = rows * self.scale**2
        for batch in self.batches:
            batch.weigh(rows, result)
        return result

    def weigh_each(self, rows: Floats) -> Floats:
        """Multiply each of many vectors (n_vectors, n_rows) by the inverse covariance."""
        return np.array([self.weigh(row) for row in rows])

    @cached_property
    def mix(self) -> sparse.csr_array | None:
        """The map as a matrix (n_rows, n_rows), or None if it only scales."""
        if not self.batches:
            return None
        alone = self._alone
        parts = [batch.entries() for batch in self.batches] + [(self.scale[alone], alone, alone)]
        values, row, column = (np.concatenate(part) for part in zip(*parts, strict=True))
        return sparse.csr_array((values, (row, column)), shape=(len(self.scale), len(self.scale)))


def whitening_of(model: CavityModel, sweeps: Sweeps, values: Floats) -> Whitening:
    """Whitening of rows at free parameters `values` (n,); a group shares reading and joint errors at its start."""
    repeatability = model.cell.repeatability
    starts = ends = np.zeros((len(sweeps), 0))
    if repeatability.any():
        beam = model.cell.beam_numbers(sweeps.beam)
        ends = model.joint_jacobian(values, sweeps.q_end, beam) * repeatability
        starts = model.joint_jacobian(values, sweeps.q_start, beam) * repeatability
        starts[sweeps.absolute] = 0.0
    return shared_whitening(Sharing.of(sweeps), sweeps.sigma, sweeps.absolute, starts, ends, sweeps.common)


def shared_whitening(
    sharing: Sharing, sigma: Floats, absolute: Bools, starts: Floats, ends: Floats, stated: Floats
) -> Whitening:
    """Whitening of rows: `sigma` (n,), misses of joints at both ends (n, n_joints), `stated` (n, n_stated)."""
    missed = (ends**2).sum(axis=1)
    variance = sigma**2 + missed + (starts**2).sum(axis=1) + (stated**2).sum(axis=1)
    # Of a group's rows: half of the reading's variance and the joints at the start are common.
    alone = stated.any(axis=1)
    if sharing.several:
        # The ends are shared too; a length that stands alone has no reading at a start.
        alone, missed = alone | absolute, 0.0 * missed
    own, reading = np.where(alone, sigma**2, sigma**2 / 2.0), np.where(alone, 0.0, sigma / np.sqrt(2.0))
    common = np.hstack([sharing.columns(reading, starts[:, starts.any(axis=0)], ends), stated])
    by_size: dict[int, list[Ints]] = {}
    for members in sharing.blocks:
        by_size.setdefault(len(members), []).append(members)
    batches = tuple(Batch.of(np.array(rows), np.sqrt(own + missed), common) for rows in by_size.values())
    return Whitening(1.0 / np.sqrt(variance), batches)
