"""Posterior draws from the netCDF file that ``fpcal sample`` writes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.files import require_readable
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws from the posterior of a cell's parameters.

    Attributes
    ----------
    cell
        The cell they belong to.
    parameters
        In the cell's order.
    values
        In um and rad, shape (n_draws, n).
    """

    cell: Cell
    parameters: ParameterSet
    values: Floats

    def thinned(self, most: int) -> "PosteriorDraws":
        """At most `most` of the draws, evenly spaced."""
        every = -(-len(self.values) // most)
        return PosteriorDraws(self.cell, self.parameters, self.values[::every])


def read_posterior(path: str | Path, cell: Cell) -> PosteriorDraws:
    """Read the draws of a posterior file.

    Raises
    ------
    InputError
        If the file is missing, no netCDF file of ``fpcal sample``, of another cell, its sampling did not converge, or
        a draw is not a number.
    """
    import h5py

    path = Path(path)
    require_readable(path)
    try:
        with h5py.File(path, "r") as file:
            _check(path, dict(file.attrs), cell)
            group = file.get("posterior")
            if not isinstance(group, h5py.Group):
                raise InputError(f"{path}: expected a group posterior, as fpcal sample writes it")
            parameters = ParameterSet(p for p in cell.parameters if p.name in group)
            columns = [_column(path, group[p.name], p.name, p.unit) for p in parameters]
    except OSError as error:
        raise InputError(f"{path}: not a netCDF file of draws ({error})") from error
    if not columns:
        raise InputError(f"{path}: group posterior: expected draws of parameters of cell {cell.name!r}")
    if len({column.shape for column in columns}) != 1 or columns[0].size == 0:
        raise InputError(f"{path}: group posterior: expected as many draws of each parameter, one or more")
    values = parameters.to_internal(np.column_stack([column.ravel() for column in columns]))
    return PosteriorDraws(cell, parameters, values)


def _check(path: Path, attributes: dict[str, object], cell: Cell) -> None:
    if "cell_sha256" not in attributes:
        raise InputError(f"{path}: attribute cell_sha256: missing, expected a file that fpcal sample wrote")
    if attributes["cell_sha256"] != cell.sha256:
        raise InputError(
            f"{path}: attribute cell_sha256: the draws are of another cell ({attributes.get('cell_name')!r}, opd "
            f"{attributes.get('opd')!r}), expected {cell.name!r}, opd {cell.opd!r}, {cell.sha256[:12]}"
        )
    if not attributes.get("converged", 1):
        raise InputError(f"{path}: attribute converged: the sampling did not converge, expected draws to be trusted")


def _column(path: Path, data: object, name: str, unit: str) -> Floats:
    import h5py

    place = f"{path}: posterior/{name}"
    if not isinstance(data, h5py.Dataset) or data.dtype.kind != "f":
        raise InputError(f"{place}: expected an array of numbers")
    stated = data.attrs.get("units", "")
    if stated != unit:
        raise InputError(f"{place}: expected the units {unit!r}, found {str(stated)[:40]!r}")
    values = np.asarray(data[()], dtype=float)
    if not np.isfinite(values).all():
        raise InputError(f"{place}: expected finite numbers")
    return values
