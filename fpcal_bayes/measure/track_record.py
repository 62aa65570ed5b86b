"""The states of a tracked cell as a campaign file holds them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.measure.hdf5_access import Reader, put_array, put_text

Floats = NDArray[np.float64]

#: Arrays of a record and their number of axes.
_ARRAYS = {
    "mean": 2,
    "covariance": 3,
    "jump": 2,
    "onset_response": 3,
    "onset_information": 3,
    "onset_score": 2,
}


@dataclass(frozen=True)
class TrackRecord:
    """States after each session, in scaled units, and what the tests remember.

    Attributes
    ----------
    cell_sha256, settings_sha256
        Hashes of the cell with its path model, and of drift sizes and limits of the tests.
    names
        Of the parameters, which stand first in each state.
    summary
        All that is not an array, as JSON.
    mean, covariance, jump
        Shapes (n_sessions, n_states), (n_sessions, n_states, n_states), (n_sessions, n_states).
    onset_response, onset_information, onset_score
        Of all sessions' regressions, one after the other, as `summary` counts them.
    """

    cell_sha256: str
    settings_sha256: str
    names: tuple[str, ...]
    summary: str
    mean: Floats
    covariance: Floats
    jump: Floats
    onset_response: Floats
    onset_information: Floats
    onset_score: Floats


def put_track(group: Any, record: TrackRecord) -> None:
    """Store a record in an HDF5 group."""
    put_text(group, "cell_sha256", record.cell_sha256)
    put_text(group, "settings_sha256", record.settings_sha256)
    put_array(group, "names", record.names)
    put_array(group, "json", [record.summary])
    for name in _ARRAYS:
        put_array(group, name, getattr(record, name))


def get_track(reader: Reader, group: Any) -> TrackRecord:
    """Read a record from an HDF5 group.

    Raises
    ------
    InputError
        If anything in it is not as `put_track` writes it.
    """
    summary = reader.texts(group, "json")
    if len(summary) != 1:
        raise InputError(f"{reader.path}: {group.name}/json: expected one text, found {len(summary)}")
    arrays = {name: reader.numbers(group, name, ndim) for name, ndim in _ARRAYS.items()}
    sessions, states = arrays["mean"].shape
    if arrays["covariance"].shape != (sessions, states, states) or arrays["jump"].shape != (sessions, states):
        raise InputError(f"{reader.path}: {group.name}/covariance: expected the shape that mean has")
    if not all(np.isfinite(values).all() for values in arrays.values()):
        raise InputError(f"{reader.path}: {group.name}: expected finite numbers")
    return TrackRecord(
        cell_sha256=reader.text_attribute(group, "cell_sha256"),
        settings_sha256=reader.text_attribute(group, "settings_sha256"),
        names=tuple(reader.texts(group, "names").tolist()),
        summary=str(summary[0]),
        **arrays,
    )
