"""The draws of a posterior file that ``fpcal sample`` wrote, and what they are worth."""

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256, require_readable
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.diagnostics import diagnose
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws from the posterior of a cell's parameters."""

    cell: Cell  # the cell they belong to
    parameters: ParameterSet  # in the cell's order
    values: Floats  # in um and rad, shape (n_draws, n)

    def thinned(self, most: int) -> "PosteriorDraws":
        """At most `most` of the draws, evenly spaced."""
        every = -(-len(self.values) // most)
        return PosteriorDraws(self.cell, self.parameters, self.values[::every])


def read_posterior(path: str | Path, cell: Cell) -> PosteriorDraws:
    """Read the draws of a posterior file."""
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


@dataclass(frozen=True)
class PosteriorSummary:
    """Draws of a posterior and what they are worth."""

    # file, sha256: name without folder, and hash of the bytes
    file: str
    sha256: str
    parameters: ParameterSet  # sampled parameters, n of them
    draws: Floats  # in the units a person reads, shape (n_chains, n_draws, n)
    prior: Floats  # draws of the prior in the same units, shape (n_prior_draws, n)
    n_ensembles: int  # independent ensembles; chains of one ensemble interact
    # rhat, ess_bulk, ess_tail: nested R-hat and effective sizes, shape (n,)
    rhat: Floats
    ess_bulk: Floats
    ess_tail: Floats
    residuals: Floats  # measured less predicted, in standard deviations of the prediction, shape (n_rows,)
    command: str  # that made the file

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return int(self.draws.shape[0] * self.draws.shape[1])


def read_posterior_summary(path: str | Path, cell: Cell) -> PosteriorSummary:
    """Read a posterior file and work out its convergence."""
    path = Path(path)
    parameters = read_posterior(path, cell).parameters
    with h5py.File(path, "r") as file:
        try:
            draws = np.stack([file["posterior"][name][()] for name in parameters.names], axis=-1)
            prior = np.stack([file["prior"][name][()].ravel() for name in parameters.names], axis=-1)
            observed, predicted = file["observed_data"]["dl_um"][()], file["posterior_predictive"]["dl_um"][()]
            attributes = dict(file.attrs)
        except (KeyError, TypeError, ValueError, OSError) as error:
            raise InputError(f"{path}: expected the groups that fpcal sample writes ({error})") from error
    if draws.ndim != 3:
        raise InputError(f"{path}: group posterior: expected draws by chain and draw")
    n_ensembles = int(np.ravel(attributes.get("n_ensembles", 1))[0])
    if n_ensembles < 1 or len(draws) % n_ensembles:
        raise InputError(f"{path}: attribute n_ensembles: expected a divisor of {len(draws)} chains")
    walkers = draws.reshape(n_ensembles, -1, draws.shape[1], draws.shape[2]).transpose(0, 2, 1, 3)
    found = diagnose(walkers)
    spread = predicted.std(axis=(0, 1))
    return PosteriorSummary(
        file=path.name,
        sha256=file_sha256(path),
        parameters=parameters,
        draws=draws,
        prior=prior,
        n_ensembles=n_ensembles,
        rhat=found.rhat,
        ess_bulk=found.ess_bulk,
        ess_tail=found.ess_tail,
        residuals=(observed - predicted.mean(axis=(0, 1))) / spread,
        command=str(attributes.get("command", "")),
    )
