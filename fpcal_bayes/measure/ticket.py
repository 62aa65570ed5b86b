"""A ticket: which sweeps to measure, at how many readings each, and until when."""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.core.typing import Ints
from fpcal_bayes.measure.protocol import read_often
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell


@dataclass(frozen=True)
class Ticket:
    """Sweeps to measure.

    Attributes
    ----------
    file
        Where it was read.
    plan
        Whole sweeps without measurement; None if nothing is to be measured.
    readings
        How many each sweep has, at equal steps; 0: the whole trace, shape (n,).
    expires_h
        Hours of the campaign, or NaN.
    expires_utc
        Unix time, or NaN.
    name
        The ticket's own, or empty.
    sha256
        Of the file.
    """

    file: str
    plan: Sweeps | None
    readings: Ints
    expires_h: float = np.nan
    expires_utc: float = np.nan
    name: str = ""
    sha256: str = ""

    def rows(self) -> Sweeps:
        """The rows that measuring gives, as a plan; a whole trace is one.

        Raises
        ------
        ValueError
            If nothing is to be measured.
        """
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
    planned = ticket.rows()
    names = set(planned.session.tolist())
    near = np.where(cell.joint_scales == 1.0, _NEAR_UM, np.radians(_NEAR_DEG))
    ends = np.hstack([planned.q_start, planned.q_end])
    taken: dict[int, int] = {}

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
        q = np.concatenate([measured.q_start[i], measured.q_end[i]])
        off = (np.abs(ends - q) / np.tile(near, 2)).max(axis=1)
        at = int(np.argmin(off + 1e6 * (planned.kind != measured.kind[i])))
        if off[at] > 1.0 or planned.kind[at] != measured.kind[i]:
            label = str(planned.label[at])
            refuse(
                i, "label", f"no row of {ticket.file} asks for it; nearest is {label!r}, {off[at]:.3g} times too far"
            )
        if at in taken:
            refuse(i, "label", f"row {taken[at]} is the same sweep of the ticket, expected each once")
        taken[at] = int(measured.rows[i])
    return len(planned) - len(taken)
