"""Sweeps whose traces gave no number to rely on, as a campaign file holds them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.measure.hdf5_access import Reader, put_array

Floats = NDArray[np.float64]

_TEXTS = ("session", "label", "reason")
_NUMBERS = {"recording": "", "dl_um": "um", "sigma_um": "um", "signed": ""}


@dataclass(frozen=True)
class DoubtfulRecord:
    """Doubtful sweeps, n of them.

    Attributes
    ----------
    session, label, reason
        Which sweep, and what is wrong with it, shape (n,).
    recording
        Its position among the campaign's recordings, from 0, shape (n,).
    dl, sigma
        The most likely change and its standard deviation, in um; NaN where there is none, shape (n,).
    signed
        Whether the sign of `dl` is known, shape (n,).
    alternatives
        Other changes that are possible, in um, a tuple each.
    """

    session: NDArray[np.str_]
    label: NDArray[np.str_]
    reason: NDArray[np.str_]
    recording: NDArray[np.int64]
    dl: Floats
    sigma: Floats
    signed: NDArray[np.bool_]
    alternatives: tuple[tuple[float, ...], ...]

    def __len__(self) -> int:
        return len(self.label)


def put_doubtful(group: Any, record: DoubtfulRecord) -> None:
    """Store a record in an HDF5 group; alternatives lie one after the other, ``alternatives_end`` cuts them."""
    for name in _TEXTS:
        put_array(group, name, getattr(record, name))
    values = (record.recording, record.dl, record.sigma, record.signed.astype(np.uint8))
    for (name, unit), array in zip(_NUMBERS.items(), values, strict=True):
        put_array(group, name, array, unit)
    put_array(group, "alternatives_um", np.array([x for each in record.alternatives for x in each]), "um")
    put_array(group, "alternatives_end", np.cumsum([len(each) for each in record.alternatives], dtype=np.int64))


def get_doubtful(reader: Reader, group: Any) -> DoubtfulRecord:
    """Read a record from an HDF5 group.

    Raises
    ------
    InputError
        If anything in it is not as `put_doubtful` writes it.
    """
    session, label, reason = (reader.texts(group, name) for name in _TEXTS)
    recording, dl, sigma, signed = (reader.numbers(group, name) for name in _NUMBERS)
    values, ends = reader.numbers(group, "alternatives_um"), reader.numbers(group, "alternatives_end")
    n = len(dl)
    place = f"{reader.path}: {group.name}"
    if any(len(column) != n for column in (session, label, reason, recording, sigma, signed, ends)):
        raise InputError(f"{place}: expected {n} values in every column")
    whole = np.isfinite(ends).all() and (ends == np.round(ends)).all() and (np.diff(ends, prepend=0) >= 0).all()
    if not whole or (n and ends[-1] != len(values)) or not np.isfinite(recording).all():
        raise InputError(f"{place}/alternatives_end: expected whole numbers that rise to {len(values)}")
    pieces = np.split(values, ends[:-1].astype(np.int64)) if n else []
    return DoubtfulRecord(
        session,
        label,
        reason,
        recording.astype(np.int64),
        dl,
        sigma,
        signed == 1,
        tuple(tuple(piece.tolist()) for piece in pieces),
    )
