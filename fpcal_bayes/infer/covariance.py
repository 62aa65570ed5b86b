"""The covariance of the measured rows, and the whitening that makes them independent with unit variance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Whitening:
    """Linear map under which the rows have unit covariance.

    Attributes
    ----------
    scale
        One over the standard deviation of each row, shape (n_rows,).
    mix
        Inverse Cholesky factor that replaces `scale` where rows share a reading, shape (n_rows, n_rows), or None.
    """

    scale: Floats
    mix: sparse.csr_array | None

    def apply(self, rows: Floats) -> Floats:
        """Whiten a vector (n_rows,) or the columns of a matrix (n_rows, n)."""
        if self.mix is not None:
            mixed: Floats = self.mix @ rows
            return mixed
        return rows * (self.scale if rows.ndim == 1 else self.scale[:, None])


def whitening_of(model: CavityModel, sweeps: Sweeps, values: Floats) -> Whitening:
    """Whitening of the rows of `sweeps`.

    A row's variance is that of its reading plus the joints' repeatability at both ends, carried through the joint
    Jacobian at `values`. Rows of a group share the reading and the joint errors at their start, which gives equal
    readings a correlation of 1/2.

    Parameters
    ----------
    model, values
        Where the joint Jacobian is taken; `values` are the free parameters in um and rad, shape (n,).
    """
    repeatability = model.cell.repeatability
    n_rows = len(sweeps)
    start_errors, variance = np.zeros((n_rows, 0)), sweeps.sigma**2
    if repeatability.any():
        ends = model.joint_jacobian(values, sweeps.q_end) * repeatability
        start_errors = model.joint_jacobian(values, sweeps.q_start) * repeatability
        start_errors[sweeps.absolute] = 0.0
        variance = variance + (ends**2).sum(axis=1) + (start_errors**2).sum(axis=1)
    scale = 1.0 / np.sqrt(variance)
    blocks = group_blocks(sweeps)
    if not blocks:
        return Whitening(scale, None)

    alone = np.ones(n_rows, dtype=bool)
    data, row_index, column_index = [], [], []
    for members in blocks:
        alone[members] = False
        covariance = 0.5 * np.outer(sweeps.sigma[members], sweeps.sigma[members])
        covariance += start_errors[members] @ start_errors[members].T
        covariance[np.diag_indices(len(members))] = variance[members]
        factor = linalg.cholesky(covariance, lower=True)
        inverse = linalg.solve_triangular(factor, np.eye(len(members)), lower=True)
        lower = np.tril_indices(len(members))
        data.append(inverse[lower])
        row_index.append(members[lower[0]])
        column_index.append(members[lower[1]])
    single = np.flatnonzero(alone)
    data.append(scale[single])
    row_index.append(single)
    column_index.append(single)
    entries = (np.concatenate(data), (np.concatenate(row_index), np.concatenate(column_index)))
    return Whitening(scale, sparse.csr_array(entries, shape=(n_rows, n_rows)))


def group_blocks(sweeps: Sweeps) -> list[NDArray[np.int64]]:
    """Positions of the rows of each group with more than one row."""
    members: dict[tuple[str, str], list[int]] = {}
    for i in np.flatnonzero(sweeps.group != ""):
        members.setdefault((str(sweeps.session[i]), str(sweeps.group[i])), []).append(int(i))
    return [np.array(rows) for rows in members.values() if len(rows) > 1]
