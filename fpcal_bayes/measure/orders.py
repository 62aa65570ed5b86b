"""The drives that a ticket asks for: one per sweep, or per group of rows."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.protocol import read_often
from fpcal_bayes.measure.ticket import Ticket


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
            raise located(ticket.file, f"only sweeps are driven, found {plan.kind[first]!s}", row=row, column="kind")
        label, n = str(plan.label[first]), int(ticket.readings[first])
        start, end = plan.q_start[first], plan.q_end[places[-1]]
        if len(places) > 1 or not group.startswith("\0"):
            if (ticket.readings[places] != 1).any():
                raise located(ticket.file, "expected 1 in rows of a group", row=row, column="readings")
            targets, labels, label = plan.q_end[places], plan.label[places].tolist(), group
        elif n <= 1:
            targets, labels = end[None], [label]
        else:
            several = read_often(plan.take(np.array([first])), n)
            targets, labels = several.q_end, several.label.tolist()
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
