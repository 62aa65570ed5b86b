"""A ticket: which sweeps to drive, at how many readings each, and until when; the orders that it makes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.core.times import clock
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.io.columns import check_names, from_columns, parsed
from fpcal_bayes.io.csv import Records, read_records
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell

#: Columns of a ticket beside those of a plan.
_OWN = ("readings", "expires_h", "expires_utc", "ticket")
_MOST_READINGS = 1000


@dataclass(frozen=True)
class Ticket:
    """Sweeps to drive.

    Attributes
    ----------
    plan
        Without measurement; None if the ticket has no rows.
    readings
        How many each sweep has, at equal steps; 0: the whole trace, shape (n,).
    expires_h
        Hours of the campaign, or NaN.
    expires_utc
        Unix time, or NaN.
    name
        The ticket's own, or empty.
    sha256
        Name of the file.
    """

    file: str
    plan: Sweeps | None
    readings: Ints
    expires_h: float
    expires_utc: float
    name: str
    sha256: str


@dataclass(frozen=True)
class Order:
    """One drive: from a start through some poses, where the length is read, and back.

    Attributes
    ----------
    row
        Line of the ticket.
    session, label, time_h, group
        The rows that come of it; `group` is empty where there is one.
    start
        Joint vector in um and rad, shape (n_joints,).
    targets, labels
        Joint vectors where the length is read, shape (n, n_joints), and the labels of their rows.
    whole
        Whether the whole way is recorded.
    """

    row: int
    session: str
    label: str
    time_h: float
    group: str
    start: Floats
    targets: Floats
    labels: tuple[str, ...]
    whole: bool


def read_ticket(path: str | Path, cell: Cell) -> Ticket:
    """Read a ticket or a plan from a CSV file; it may have no rows.

    Raises
    ------
    InputError
        If the file holds measured values, or anything in it is not as documented.
    """
    path = Path(path)
    records = read_records(path, "a header and sweeps")
    for name in ("dl_um", "sigma_um"):
        if name in records.header:
            raise located(path, f"{name} holds what was measured, expected a ticket or a plan", row=records.header_row)
    check_names(records.header, cell, path, plan=True, row=records.header_row, also=_OWN)
    own = _own_columns(records)
    plan = None
    if len(records.rows):
        table = {name: values for name, values in parsed(records).items() if name not in _OWN}
        plan = from_columns(table, cell, str(path), records.rows, plan=True)
    return Ticket(str(path), plan, own.readings, own.expires_h, own.expires_utc, own.name, file_sha256(path))


@dataclass(frozen=True)
class _Own:
    readings: Ints
    expires_h: float
    expires_utc: float
    name: str


def _own_columns(records: Records) -> _Own:
    """The columns that only tickets have."""
    path, rows, texts = records.path, records.rows, records.columns()
    readings = np.ones(len(rows), dtype=np.int64)
    if "readings" in texts and len(rows):
        found = records.numbers("readings", [text or "1" for text in texts["readings"]])
        bad = (found != np.round(found)) | (found < 0) | (found > _MOST_READINGS)
        if bad.any():
            raise located(
                path,
                f"expected a whole number from 0 to {_MOST_READINGS}, found {found[bad][0]:g}",
                row=int(rows[np.argmax(bad)]),
                column="readings",
            )
        readings = found.astype(np.int64)
    hours = records.numbers("expires_h", [text or "1e300" for text in texts.get("expires_h", ())], finite=True)
    moments = []
    for text, row in zip(texts.get("expires_utc", ()), rows.tolist(), strict=False):
        try:
            moments += [clock(text).timestamp()] if text else []
        except ValueError as error:
            raise located(
                path, "expected ISO 8601 as in 2024-05-01T08:30:00Z", row=row, column="expires_utc"
            ) from error
    names = set(texts.get("ticket", ()))
    if len(names) > 1:
        raise located(path, "expected rows of one ticket", row=int(rows[0]), column="ticket")
    expires_h = float(min(hours, default=np.inf))
    return _Own(
        readings, expires_h if expires_h < 1e300 else np.nan, min(moments, default=np.nan), next(iter(names), "")
    )


def orders_of(ticket: Ticket) -> list[Order]:
    """The drives of a ticket: a row with n readings is one, and so are the rows of a group.

    Raises
    ------
    InputError
        If a row is no sweep, or a group's row asks for readings of its own.
    """
    plan = ticket.plan
    if plan is None:
        return []
    if len(plan.sessions) > 1:
        raise InputError(f"{ticket.file}: sessions {', '.join(plan.sessions)}: expected a ticket of one session")
    orders: list[Order] = []
    members: dict[str, list[int]] = {}
    for i in range(len(plan)):
        members.setdefault(str(plan.group[i]) or f"\0{i}", []).append(i)
    for group, places in members.items():
        first, row = places[0], int(plan.rows[places[0]])
        if (plan.kind[places] != "sweep").any():
            raise located(ticket.file, f"a rig drives sweeps, found {plan.kind[first]!s}", row=row, column="kind")
        label, n = str(plan.label[first]), int(ticket.readings[first])
        start, end = plan.q_start[first], plan.q_end[places[-1]]
        if len(places) > 1 or not group.startswith("\0"):
            if (ticket.readings[places] != 1).any():
                raise located(ticket.file, "expected 1 in rows of a group", row=row, column="readings")
            targets, labels, label = plan.q_end[places], plan.label[places].tolist(), group
        elif n <= 1:
            targets, labels = end[None], [label]
        else:
            share = np.arange(1, n + 1)[:, None] / n
            targets = start + (end - start) * share
            targets[-1] = end
            labels = [_reading_label(label, i, n) for i in range(1, n + 1)]
        orders.append(
            Order(
                row=row,
                session=str(plan.session[first]),
                label=label,
                time_h=float(plan.time_h[first]),
                group=(label or f"row {row}") if len(targets) > 1 else "",
                start=start,
                targets=targets,
                labels=tuple(labels),
                whole=n == 0,
            )
        )
    return orders


def _reading_label(label: str, i: int, n: int) -> str:
    """The label of reading i of n; the middle one of two and the last one as the protocol with midpoints calls them."""
    return label if i == n else f"{label}-mid" if n == 2 else f"{label}-{i}/{n}"
