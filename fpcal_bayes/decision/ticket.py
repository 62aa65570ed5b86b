"""The ticket of a decision: what to measure now, under which name, and until when."""

import hashlib

import numpy as np

from fpcal_bayes.core.times import clock
from fpcal_bayes.decision.decision import Decision
from fpcal_bayes.measure.sweeps import Sweeps, as_plan
from fpcal_bayes.measure.ticket import Ticket, empty_ticket

#: Hours after which sweeps are to be chosen anew: the cell has drifted on.
TICKET_H = 4.0


def basis_of(campaign: Sweeps) -> str:
    """What a ticket's name begins with: it tells one state of a campaign from another."""
    content = (campaign.session.tolist(), campaign.time_h.tolist(), campaign.dl.tolist())
    return f"t-{hashlib.sha256(repr(content).encode()).hexdigest()[:12]}"


def ticket_of(decision: Decision, campaign: Sweeps, file: str = "ticket", *, now_utc: float | None = None) -> Ticket:
    """What a decision asks for, as a ticket; without sweeps where nothing is to be measured.

    Its session has a name that `campaign`, the sweeps of all sessions so far, does not hold. `file` is its name for
    messages, `now_utc` the Unix time of the decision: by default the campaign's clock times tell, if it has some.
    """
    if decision.action == "hold" or decision.sweeps is None or len(decision.sweeps) == 0:
        return empty_ticket(file)
    taken, number = {name.strip().casefold() for name in campaign.sessions}, len(campaign.sessions)
    while f"{decision.action}-{number}" in taken:
        number += 1
    plan = as_plan(decision.sweeps, session=f"{decision.action}-{number}", time_h=decision.now_h, file=file)
    expires_h, expires_utc = decision.now_h + TICKET_H, np.nan
    stamped = np.flatnonzero(campaign.utc != "")
    if now_utc is not None:
        expires_utc = now_utc + 3600.0 * TICKET_H
    elif len(stamped):
        at = stamped[-1]
        expires_utc = clock(str(campaign.utc[at])).timestamp() + 3600.0 * (expires_h - float(campaign.time_h[at]))
    name = f"{basis_of(campaign)}-{decision.now_h * 60.0:.0f}"
    return Ticket(file, plan, np.ones(len(plan), dtype=np.int64), expires_h, expires_utc, name)
