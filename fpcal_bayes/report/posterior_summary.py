"""A posterior file in short: what a report says about the draws, and their figures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.files import file_sha256
from fpcal_bayes.infer.posterior_file import read_posterior
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PosteriorSummary:
    """Draws of a posterior and what they are worth.

    Attributes
    ----------
    file, sha256
        Name without folder, and hash of the bytes.
    parameters
        Sampled parameters, n of them.
    draws
        In the units a person reads, shape (n_chains, n_draws, n).
    prior
        Draws of the prior in the same units, shape (n_prior_draws, n).
    n_ensembles
        Independent ensembles; chains of one ensemble interact.
    rhat, ess_bulk, ess_tail
        Nested R-hat and effective sizes, shape (n,).
    residuals
        Measured less predicted, in standard deviations of the prediction, shape (n_rows,).
    command
        That made the file.
    """

    file: str
    sha256: str
    parameters: ParameterSet
    draws: Floats
    prior: Floats
    n_ensembles: int
    rhat: Floats
    ess_bulk: Floats
    ess_tail: Floats
    residuals: Floats
    command: str

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return int(self.draws.shape[0] * self.draws.shape[1])


def read_posterior_summary(path: str | Path, cell: Cell) -> PosteriorSummary:
    """Read a posterior file and work out its convergence.

    Raises
    ------
    InputError
        As `read_posterior` does, and if the file lacks prior draws or predictions.
    """
    import h5py

    from fpcal_bayes.errors import InputError
    from fpcal_bayes.infer.posterior.diagnostics import diagnose

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
