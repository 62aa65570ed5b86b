"""A ticket: which sweeps to measure, at how many readings each, until when, and the drives that it asks for."""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from scipy.optimize import linear_sum_assignment

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.protocol import read_often, seen_by_all
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell


@dataclass(frozen=True)
class Ticket:
    """Sweeps to measure."""

    file: str  # where it was read
    plan: Sweeps | None  # whole sweeps without measurement; None if nothing is to be measured
    readings: Ints  # how many each sweep has, at equal steps; 0: the whole trace, shape (n,)
    expires_h: float = np.nan  # hours of the campaign, or NaN
    expires_utc: float = np.nan  # Unix time, or NaN
    name: str = ""  # the ticket's own, or empty
    sha256: str = ""  # of the file

    def rows(self) -> Sweeps:
        """The rows that measuring gives, as a plan; a whole trace is one. `ValueError` if there are none."""
        if self.plan is None:
            raise ValueError("a ticket without sweeps has no rows")
        return read_often(self.plan, np.maximum(self.readings, 1))

    def content(self) -> dict[str, object] | None:
        """Name, session and expiry for JSON; None if nothing is to be measured."""
        if self.plan is None:
            return None
        until = {"expires_h": self.expires_h, "expires_utc": self.expires_utc}
        said: dict[str, object] = {name: value for name, value in until.items() if np.isfinite(value)}
        if "expires_utc" in said:
            said["expires_utc"] = iso(self.expires_utc)
        return {"ticket": self.name, "session": str(self.plan.session[0]), "n_rows": len(self.rows()), **said}


def empty_ticket(file: str) -> Ticket:
    """A ticket that asks for nothing."""
    return Ticket(file, None, np.zeros(0, dtype=np.int64))


#: How far a measured row may stand from the ticket's: what controllers miss, not another sweep.
_NEAR_UM, _NEAR_DEG = 1.0, 0.05


def check_measured(ticket: Ticket, measured: Sweeps, cell: Cell) -> int:
    """How many rows of a ticket were not measured; `InputError` unless each measured row stands for another one."""
    planned = seen_by_all(ticket.rows(), cell)
    names = set(planned.session.tolist())
    near = np.tile(np.where(cell.joint_scales == 1.0, _NEAR_UM, np.radians(_NEAR_DEG)), 2)
    ends, read = (np.hstack([sweeps.q_start, sweeps.q_end]) for sweeps in (planned, measured))
    off = np.array([(np.abs(ends - q) / near).max(axis=1) for q in read])
    beam, read_by = (cell.beam_numbers(sweeps.beam) for sweeps in (planned, measured))
    off += 1e6 * ((planned.kind != measured.kind[:, None]) | (beam != read_by[:, None]))
    # A ticket may ask for a sweep twice, or for two that are near each other: as many as can be stand for one each.
    rows, columns = linear_sum_assignment(np.minimum(off, 1.0 + len(planned)))
    row_of = {at: i for i, at in zip(rows.tolist(), columns.tolist(), strict=True) if off[i, at] <= 1.0}
    stands = set(row_of.values())

    def refuse(i: int, column: str, message: str) -> NoReturn:
        raise located(measured.file, message, row=int(measured.rows[i]), column=column)

    for i in range(len(measured)):
        if str(measured.session[i]) not in names:
            found = f"found {str(measured.session[i])!r}"
            refuse(i, "session", f"expected {' or '.join(sorted(names))}, the session of {ticket.file}, {found}")
        utc = str(measured.utc[i])
        if measured.time_h[i] > ticket.expires_h or (utc and clock(utc).timestamp() > ticket.expires_utc):
            until = f"{ticket.expires_h:g} h" if measured.time_h[i] > ticket.expires_h else iso(ticket.expires_utc)
            refuse(i, "time_h", f"measured after the ticket expired at {until}: ask for a new one")
        at = int(np.argmin(off[i]))
        if off[i, at] > 1.0:
            nearest = f"nearest is {str(planned.label[at])!r}, {off[i, at]:.3g} times too far"
            refuse(i, "label", f"no row of {ticket.file} asks for it; {nearest}")
        if i not in stands:
            again = int(measured.rows[row_of[at]])
            refuse(i, "label", f"row {again} is the same sweep of the ticket, expected each once")
    return len(planned) - len(stands)


@dataclass(frozen=True)
class Order:
    """One drive: from a start through some poses, where the length is read, and back."""

    row: int  # line of the ticket
    # session, label, time_h, group: the rows that come of it; `group` is empty where there is one, without a group of
    # its own
    session: str
    label: str
    time_h: float
    group: str
    start: Floats  # joint vector in um and rad, shape (n_joints,)
    # targets, labels: joint vectors where the length is read, shape (n, n_joints), and the labels of their rows
    targets: Floats
    labels: tuple[str, ...]
    whole: bool  # whether the whole way is recorded


def orders_of(ticket: Ticket) -> list[Order]:
    """The drives of a ticket: a row with n readings is one, and so are the rows of a group."""
    plan = ticket.plan
    if plan is None:
        return []
    if len(plan.sessions) > 1:
        raise InputError(f"{ticket.file}: sessions {', '.join(plan.sessions)}: expected a ticket of one session")
    for i, row in enumerate(plan.rows.tolist()):
        if plan.kind[i] != "sweep":
            found = f"only sweeps are driven, found {plan.kind[i]!s}: leave that row out"
            raise located(ticket.file, found, row=row, column="kind")
        if plan.group[i] and ticket.readings[i] != 1:
            raise located(ticket.file, "expected 1 in rows of a group", row=row, column="readings")
    rows, members = ticket.rows(), dict[str, list[int]]()
    for i in range(len(rows)):
        members.setdefault(str(rows.group[i]) or f"\0{i}", []).append(i)
    whole = set(plan.rows[ticket.readings == 0].tolist())
    return [
        Order(
            row=int(rows.rows[first]),
            session=str(rows.session[first]),
            label=str(rows.group[first] or rows.label[first]),
            time_h=float(rows.time_h[first]),
            group=str(rows.group[first]),
            start=rows.q_start[first],
            targets=rows.q_end[[first, *others]],
            labels=tuple(rows.label[[first, *others]].tolist()),
            whole=int(rows.rows[first]) in whole,
        )
        for first, *others in members.values()
    ]
