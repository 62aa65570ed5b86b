"""A ticket: which sweeps to measure, at how many readings each, and until when."""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from scipy.optimize import linear_sum_assignment

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.core.typing import Ints
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
    """How many rows of a ticket were not measured; `InputError` if what was measured is not what the ticket asks for.

    Every row must belong to the ticket's session, lie before it expires, and stand within 1 um and 0.05 deg of a row of
    the ticket that no other one stands for.
    """
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
            label = str(planned.label[at])
            refuse(
                i, "label", f"no row of {ticket.file} asks for it; nearest is {label!r}, {off[i, at]:.3g} times too far"
            )
        if i not in stands:
            again = int(measured.rows[row_of[at]])
            refuse(i, "label", f"row {again} is the same sweep of the ticket, expected each once")
    return len(planned) - len(stands)
