"""Tickets and plans as files: CSV with the columns of a plan, never a measured value."""

from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.io import columns
from fpcal_bayes.io.campaign import write_campaign
from fpcal_bayes.io.csv import read_records, write_table
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.ticket import Ticket
from fpcal_bayes.model.cell.cell import Cell


def read_ticket(path: str | Path, cell: Cell) -> Ticket:
    """Read a ticket or a plan from a CSV file; it may have no rows, and holds no measured values."""
    path = Path(path)
    records = read_records(path, "a header and sweeps")
    for name in ("dl_um", "sigma_um"):
        if name in records.header:
            raise located(path, f"{name} holds what was measured, expected a ticket or a plan", row=records.header_row)
    columns.check_names(records.header, cell, path, plan=True, row=records.header_row)
    table, n = columns.parsed(records), len(records.rows)
    plan = columns.from_columns(table, cell, str(path), records.rows, plan=True, whole=True) if n else None
    readings = columns.readings_of(table, str(path), records.rows)
    moments = [clock(text).timestamp() for text in table.get("expires_utc", np.array([])).tolist() if text]
    hours = table.get("expires_h", np.array([]))
    names = set(table["ticket"].tolist()) if "ticket" in table else {""}
    if len(names) > 1:
        raise located(path, "expected rows of one ticket", row=int(records.rows[0]), column="ticket")
    return Ticket(
        str(path),
        plan,
        readings,
        expires_h=float(np.nanmin(hours)) if np.isfinite(hours).any() else np.nan,
        expires_utc=min(moments, default=np.nan),
        name=min(names, default=""),
        sha256=file_sha256(path),
    )


def write_ticket(path: str | Path, ticket: Ticket, cell: Cell) -> None:
    """Write a ticket or a plan to a CSV file, whole or not at all; without sweeps it is a header alone."""
    names = (*columns.LEADING, *columns.joint_columns(cell), *columns.PLAN)
    if ticket.plan is None:
        write_table(Path(path), {name: np.array([]) for name in names})
        return
    write_table(Path(path), columns.to_columns(ticket.plan, cell, path, asked=asked_of(ticket)))


def write_plan(path: str | Path, ticket: Ticket, cell: Cell) -> None:
    """Write a plan in the format that the file's suffix names, CSV or HDF5; as `write_ticket`."""
    if ticket.plan is None or Path(path).suffix.lower() not in HDF5_SUFFIXES:
        write_ticket(path, ticket, cell)
    else:
        write_campaign(path, Campaign.of(ticket.plan, cell), cell, asked=asked_of(ticket))


def asked_of(ticket: Ticket) -> dict[str, Any]:
    """The columns that say how a plan is to be measured, only those that say something."""
    n = len(ticket.readings)
    asked: dict[str, Any] = {}
    if (ticket.readings != 1).any() or ticket.name:
        asked["readings"] = ticket.readings
    if np.isfinite(ticket.expires_h):
        asked["expires_h"] = np.full(n, ticket.expires_h)
    if np.isfinite(ticket.expires_utc):
        asked["expires_utc"] = np.full(n, iso(ticket.expires_utc))
    return asked | ({"ticket": np.full(n, ticket.name)} if ticket.name else {})
