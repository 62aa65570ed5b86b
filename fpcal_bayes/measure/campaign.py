"""A campaign in memory: sweeps with the cell, the program, and the truth, track and recordings beside."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.core.version import __version__
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import TruthRecord
from fpcal_bayes.model.cell.beams import Opd
from fpcal_bayes.model.cell.cell import Cell


@dataclass(frozen=True)
class TrackRecord:
    """States after each session, in scaled units, and what the tests remember."""

    #: cell_sha256, settings_sha256: Hashes of the cell with its path model, and of drift sizes and limits of the tests.
    cell_sha256: str
    settings_sha256: str
    names: tuple[str, ...]  # of the parameters, which stand first in each state
    summary: str  # all that is not an array, as JSON
    #: mean, covariance, jump: Shapes (n_sessions, n_states), (n_sessions, n_states, n_states), (n_sessions, n_states).
    mean: Floats
    covariance: Floats
    jump: Floats
    #: onset_response, onset_information, onset_score: Of all sessions' regressions, one after the other, as `summary`
    #: counts them.
    onset_response: Floats
    onset_information: Floats
    onset_score: Floats


@dataclass(frozen=True)
class DoubtfulRecord:
    """Doubtful sweeps, n of them."""

    #: session, label, reason: Which sweep, and what is wrong with it, shape (n,).
    session: NDArray[np.str_]
    label: NDArray[np.str_]
    reason: NDArray[np.str_]
    recording: NDArray[np.int64]  # its position among the campaign's recordings, from 0, shape (n,)
    #: dl, sigma: The most likely change and its standard deviation, in um; NaN where there is none, shape (n,).
    dl: Floats
    sigma: Floats
    signed: NDArray[np.bool_]  # whether the sign of `dl` is known, shape (n,)
    alternatives: tuple[tuple[float, ...], ...]  # other changes that are possible, in um, a tuple each

    def __len__(self) -> int:
        return len(self.label)


@dataclass(frozen=True)
class Campaign:
    """What a campaign file holds.

    Attributes
    ----------
    sweeps
        Sweeps of all sessions, measured or planned.
    cell_name, cell_sha256, opd
        The cell that was measured; the hash is that of the cell with this path model.
    program_version, command, seed
        How the file came about; `seed` of a simulation, else None.
    truth
        What a simulation was made from, else None.
    track
        States that ``fpcal track`` left, or None.
    recordings
        The traces that the sweeps were read from, or None.
    doubtful
        Sweeps of the recordings that gave no reliable number and are no rows of `sweeps`, or None.
    about
        Who measured with which instruments, in words: operator, serial numbers.
    """

    sweeps: Sweeps
    cell_name: str
    cell_sha256: str
    opd: Opd
    program_version: str
    command: str
    seed: int | None = None
    truth: TruthRecord | None = None
    track: TrackRecord | None = None
    recordings: TraceIndex | None = None
    doubtful: DoubtfulRecord | None = None
    about: str = ""

    @classmethod
    def of(cls, sweeps: Sweeps, cell: Cell, *, command: str = "", **beside: Any) -> "Campaign":
        """A campaign of `cell`, made by this version of the program; `beside` are other fields."""
        return cls(sweeps, cell.name, cell.sha256, cell.opd, __version__, command, **beside)
