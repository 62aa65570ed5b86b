"""A measured session joins its campaign."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.io.sweeps import append_sweeps, read_sweeps
from fpcal_bayes.io.tickets import read_ticket, write_ticket
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import check_measured, empty_ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.margin import prior_draws
from fpcal_bayes.tracking.sessions import check_sessions, hours_at

#: A row is far from what a cell allows beyond so many standard deviations of its prior, so much of it and so many um.
_FAR_SD, _FAR_SHARE, _FAR_UM = 10.0, 0.1, 1.0


@dataclass(frozen=True)
class Appended:
    """What joined a campaign."""

    sessions: tuple[str, ...]
    n_rows: int
    n_missing: int  # rows that the ticket asks for and that were not measured
    n_sessions: int  # of the campaign now


def append(
    campaign: str | Path,
    measured: str | Path | Sweeps,
    cell: Cell,
    *,
    ticket: str | Path | None = None,
    now: float | None = None,
) -> Appended:
    """Add measured sessions, a file or what was read, to a campaign and empty its ticket; nothing if that asks nothing.

    Sessions that are there already, under a ticket that was not emptied, are taken as done; those after `now`, in Unix
    time, are refused. Where anything is refused the campaign stays as it was.
    """
    asked = None if ticket is None else read_ticket(ticket, cell)
    if asked is not None and asked.plan is None:
        return Appended((), 0, 0, 0)
    sweeps = measured if isinstance(measured, Sweeps) else read_sweeps(measured, cell)
    missing = 0 if asked is None else check_measured(asked, sweeps, cell)

    def check(joined: Sweeps) -> None:
        before = joined.take(np.arange(len(joined) - len(sweeps)))
        _refuse_again(sweeps, before)
        _refuse_early(sweeps, before)
        _refuse_impossible(sweeps, cell)
        check_sessions(joined, None if now is None else hours_at(now, joined))

    try:
        joined = append_sweeps(campaign, sweeps, cell, check)
    except InputError:
        if ticket is None or not _is_there(read_sweeps(campaign, cell), sweeps):
            raise
        # A program that was ended between the two steps runs again.
        write_ticket(ticket, empty_ticket(str(ticket)), cell)
        return Appended((), 0, 0, 0)
    if ticket is not None:
        # Used up: whoever measures whenever the ticket has rows does not measure twice.
        write_ticket(ticket, empty_ticket(str(ticket)), cell)
    return Appended(sweeps.sessions, len(sweeps), missing, len(joined.sessions))


def _is_there(before: Sweeps, sweeps: Sweeps) -> bool:
    """Whether a campaign holds these very sessions."""
    parts = [(before.take(before.session == name), sweeps.of_session(name)) for name in sweeps.sessions]
    return all(_contents(there) == _contents(own) for there, own in parts)


def _refuse_again(sweeps: Sweeps, before: Sweeps) -> None:
    """Refuse a session that the campaign holds already, under a name that differs by case or blanks or another one."""
    names = {name.strip().casefold(): name for name in before.sessions}
    known = dict(zip(_contents(before), before.session.tolist(), strict=True))
    for name in sweeps.sessions:
        part = sweeps.take(sweeps.session == name)
        row, held = int(part.rows[0]), [session for content in _contents(part) if (session := known.get(content))]
        twin = names.get(name.strip().casefold())
        if twin is not None:
            what = f"session {twin!r} is in the campaign, expected a new name"
            raise located(sweeps.file, what, row=row, column="session")
        # One reading may repeat by chance, since counted fringes are whole numbers; not most of a session.
        if 2 * len(held) > len(part):
            text = f"session {held[0]!r} of the campaign holds {len(held)} of these {len(part)} rows"
            raise located(sweeps.file, text, row=row)


def _refuse_early(sweeps: Sweeps, before: Sweeps) -> None:
    """Refuse sessions that would take the place of the calibration: the first session is it."""
    first, row = before.sessions[0], int(np.argmin(sweeps.time_h))
    end = float(before.time_h[before.session == first].max())
    if sweeps.time_h[row] <= end:
        found = f"found {sweeps.time_h[row]:g} h, expected after the calibration {first!r}, which ends at {end:g} h"
        raise located(sweeps.file, found, row=int(sweeps.rows[row]), column="time_h")


def _refuse_impossible(sweeps: Sweeps, cell: Cell) -> None:
    """Refuse a session most of whose telling rows are far from what the cell's prior allows, as in another unit."""
    model, draws = prior_draws(cell)
    lengths = model.predict(draws, sweeps.laid_out(model))
    measured = np.where(sweeps.signed, sweeps.dl, np.abs(sweeps.dl))
    lengths = np.where(sweeps.signed, lengths, np.abs(lengths))
    middle, spread = lengths.mean(axis=0), _FAR_SD * lengths.std(axis=0) + _FAR_UM
    far = np.abs(measured - middle) > spread + _FAR_SHARE * np.abs(middle)
    if 2 * far.sum() > (far | (np.abs(middle) > spread)).sum():
        worst = int(np.argmax(np.abs(measured - middle) / spread))
        what = f"expected {middle[worst]:.4g} um within {spread[worst]:.2g}, found {sweeps.dl[worst]:.6g}: check units"
        raise located(sweeps.file, what, row=int(sweeps.rows[worst]), column="dl_um")


def _contents(sweeps: Sweeps) -> list[tuple[float, ...]]:
    return [tuple(row) for row in np.column_stack([sweeps.q_start, sweeps.q_end, sweeps.dl]).tolist()]
