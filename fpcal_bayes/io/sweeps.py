"""Sweeps from and to a file of either format: CSV or HDF5."""

from pathlib import Path

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import require_readable
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.csv import read_csv, write_csv
from fpcal_bayes.io.hdf5 import is_hdf5
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell

HDF5_SUFFIXES = (".h5", ".hdf5")


def is_campaign_file(path: str | Path) -> bool:
    """Whether a file is to be read as HDF5: it begins like one or is called ``.h5`` or ``.hdf5``.

    Raises
    ------
    InputError
        If the file is missing, a folder, empty or not readable.
    """
    path = Path(path)
    require_readable(path)
    return path.suffix.lower() in HDF5_SUFFIXES or is_hdf5(path)


def read_sweeps(path: str | Path, cell: Cell, *, plan: bool = False) -> Sweeps:
    """Read sweeps from a CSV file or a campaign file.

    Parameters
    ----------
    path
        HDF5 if `is_campaign_file`, else CSV.
    plan
        Accept sweeps without measurement too.

    Raises
    ------
    InputError
        If anything in the file is not as documented.
    """
    return read_campaign(path, cell, plan=plan).sweeps if is_campaign_file(path) else read_csv(path, cell, plan=plan)


def write_sweeps(path: str | Path, sweeps: Sweeps, cell: Cell, *, command: str = "", seed: int | None = None) -> None:
    """Write sweeps in the format that the file's suffix names: ``.csv``, ``.h5`` or ``.hdf5``.

    Parameters
    ----------
    command, seed
        How the sweeps came about; kept in a campaign file only.

    Raises
    ------
    InputError
        If the suffix is another one, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix in HDF5_SUFFIXES:
        write_campaign(path, Campaign.of(sweeps, cell, command=command, seed=seed), cell)
    elif suffix == ".csv":
        write_csv(path, sweeps, cell)
    else:
        raise InputError(f"{path}: expected a file name that ends in .csv, {' or '.join(HDF5_SUFFIXES)}")
