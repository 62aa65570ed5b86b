"""What half wavelengths taken off rows do to the square of an innovation."""

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from fpcal_bayes.infer.covariance import Whitening
from fpcal_bayes.track.filter import Innovation, State
from fpcal_bayes.track.measurement import SweepMeasurement

Floats = NDArray[np.float64]


class RowChanges(Protocol):
    """An innovation whose rows change by whole half wavelengths.

    With `w` half wavelengths taken off row i, its square becomes ``squared - 2 w along[i] + w**2 size[i]``.
    """

    @property
    def squared(self) -> float:
        """Normalised innovation squared with the changes made so far."""
        ...

    @property
    def along(self) -> Floats:
        """See above, shape (n_rows,)."""
        ...

    @property
    def size(self) -> Floats:
        """See above, shape (n_rows,)."""
        ...

    def taken_off(self, row: int, waves: int) -> Self:
        """With whole half wavelengths taken off one row."""
        ...


@dataclass(frozen=True)
class FewRows:
    """A `RowChanges` that holds the whitened rows themselves: a matrix of rows by rows.

    Attributes
    ----------
    whitened
        Innovation in units of its own standard deviations, shape (n_rows,).
    units, half_wave
        One um of each row in the same units, shape (n_rows, n_rows), and half a wavelength in um.
    columns, size
        Half a wavelength of each row, and its square, shapes (n_rows, n_rows) and (n_rows,).
    """

    whitened: Floats
    units: Floats
    half_wave: float
    columns: Floats
    size: Floats

    @classmethod
    def of(cls, whitening: Whitening, innovation: Innovation, half_wave: float) -> Self:
        """Of an innovation that holds every row."""
        single = whitening.apply(np.eye(innovation.dof))
        units = linalg.solve_triangular(innovation.factor, single, lower=True)
        columns = units * half_wave
        return cls(innovation.whitened, units, half_wave, columns, (columns**2).sum(axis=0))

    @property
    def squared(self) -> float:
        """See `RowChanges`."""
        return float(self.whitened @ self.whitened)

    @property
    def along(self) -> Floats:
        """See `RowChanges`."""
        result: Floats = self.columns.T @ self.whitened
        return result

    def taken_off(self, row: int, waves: int) -> Self:
        """See `RowChanges`."""
        return replace(self, whitened=self.whitened - waves * self.half_wave * self.units[:, row])


@dataclass(frozen=True)
class ManyRows:
    """A `RowChanges` whose cost is linear in rows, by the Woodbury identity.

    With the whitened Jacobian ``H = Q R``, the inverse covariance of the whitened rows is ``I - Q M Q'``, where
    ``M = I - (I + R P R')^-1`` has a row for each state.

    Attributes
    ----------
    squared, along, size
        See `RowChanges`.
    own
        Product of the half wavelengths of each two rows without the state, shape (n_rows, n_rows), nearly all zero.
    seen, weighed
        Half a wavelength of each row along Q, and times M, both of shape (n_rows, n_states).
    """

    squared: float
    along: Floats
    size: Floats
    own: sparse.csc_array
    seen: Floats
    weighed: Floats

    @classmethod
    def of(cls, whitening: Whitening, misfit: Floats, jacobian: Floats, covariance: Floats, half_wave: float) -> Self:
        """Of a linearisation of all rows.

        Parameters
        ----------
        misfit, jacobian
            Whitened, shapes (n_rows,) and (n_rows, n_states).
        covariance
            Of the predicted state, shape (n_states, n_states).
        half_wave
            Half a wavelength in um.
        """
        mix = sparse.diags_array(whitening.scale) if whitening.mix is None else whitening.mix
        waves = half_wave * sparse.csr_array(mix)
        directions, triangle = np.linalg.qr(jacobian)
        spread = np.eye(len(triangle)) + triangle @ covariance @ triangle.T
        explained = np.eye(len(triangle)) - np.linalg.inv(spread)
        left = misfit - directions @ (explained @ (directions.T @ misfit))
        own, seen = sparse.csc_array(waves.T @ waves), waves.T @ directions
        weighed = seen @ explained
        size = own.diagonal() - (seen * weighed).sum(axis=1)
        return cls(float(misfit @ left), waves.T @ left, size, own, seen, weighed)

    def taken_off(self, row: int, waves: int) -> Self:
        """See `RowChanges`."""
        squared = self.squared - 2.0 * waves * self.along[row] + waves**2 * self.size[row]
        along = self.along + waves * (self.weighed @ self.seen[row])
        entries = slice(self.own.indptr[row], self.own.indptr[row + 1])
        along[self.own.indices[entries]] -= waves * self.own.data[entries]
        return replace(self, squared=float(squared), along=along)


def row_changes(measurement: SweepMeasurement, innovation: Innovation, predicted: State) -> RowChanges:
    """The changes of half a wavelength that the rows of a session may have.

    Parameters
    ----------
    innovation, predicted
        Of the session, and the state that it is linearised at.
    """
    half_wave = 0.5 * measurement.model.cell.wavelength
    if len(innovation.misfit) == innovation.dof:
        return FewRows.of(measurement.whitening, innovation, half_wave)
    misfit, jacobian = measurement.linearise(predicted.mean)
    return ManyRows.of(measurement.whitening, misfit, jacobian, predicted.covariance, half_wave)
