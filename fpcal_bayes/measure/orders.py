"""The drives that a ticket asks for: one per sweep, or per group of rows."""

from dataclasses import dataclass

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.ticket import Ticket


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
