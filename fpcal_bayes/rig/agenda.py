"""What is to be measured and what has been: an object that an adaptive experiment asks and tells.

It satisfies the structural protocols of such frameworks (`suggest`, `ingest`, `should_stop`, `checkpoint`) without
depending on one. Beside the session's file lies a journal while the session lasts: a line each drive, on the disk
before the next one begins. Whatever ends the program, the next one goes on from there.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import read_text, require_suffix, require_writable
from fpcal_bayes.core.times import clock as read_clock
from fpcal_bayes.core.times import iso
from fpcal_bayes.io.recordings import write_recordings
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES, write_sweeps
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Order, Ticket, orders_of
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.rig.results import doubtful_of, recordings_of, sweeps_of
from fpcal_bayes.rig.settings import IDSDevice, Rig

SCHEMA = "fpcal-measure/1"

#: So many sweeps in disturbance one after the other, and something is wrong with the cell.
_MOST_DISTURBED = 3


@dataclass(frozen=True)
class Origin:
    """When the campaign began."""

    moment_s: float  # Unix time
    known: bool  # whether a clock time of the campaign says so; else the ticket's own time is taken to be now


def origin_of(ticket: Ticket, campaign: Sweeps | None, now_s: float) -> Origin:
    """When the campaign of a ticket began; `InputError` if it holds future rows, or the ticket's session already."""
    planned = 0.0 if ticket.plan is None else float(ticket.plan.time_h.max())
    if campaign is None:
        return Origin(now_s - 3600.0 * planned, False)
    if ticket.plan is not None:
        for session in ticket.plan.sessions:
            if session in campaign.sessions:
                what = "is in the campaign already: the ticket is used up"
                raise InputError(f"{ticket.file}: session {session!r} {what}")
    last, stamped = float(campaign.time_h.max()), [i for i, text in enumerate(campaign.utc) if text]
    if not stamped:
        return Origin(now_s - 3600.0 * max(planned, last), False)
    i = stamped[-1]
    began = read_clock(str(campaign.utc[i])).timestamp() - 3600.0 * float(campaign.time_h[i])
    if now_s < began + 3600.0 * last:
        raise InputError(f"{ticket.file}: now is {iso(now_s)}, before the campaign's last row: check the clocks")
    return Origin(began, True)


class Agenda:
    """The orders of a ticket and what came of them, with a journal beside the session's file `output`."""

    def __init__(self, ticket: Ticket, cell: Cell, rig: Rig, output: Path, origin: Origin, command: str = "") -> None:
        self.ticket = ticket
        self.cell = cell
        self.rig = rig
        self.output = output
        self.orders: Sequence[Order] = orders_of(ticket)
        self.outcomes: dict[int, dict[str, Any]] = {}
        self.origin = origin
        self._command = command
        self._journal = output.with_name(f"{output.name}.journal")
        self._disturbed = 0
        self._offered: set[int] = set()
        require_suffix(output, ".csv", *HDF5_SUFFIXES)
        require_writable(output)
        whole = next((order.row for order in self.orders if order.whole), None)
        if whole is not None and isinstance(rig.instrument, IDSDevice):
            what = "0 asks for a trace, expected a rig whose interferometer has record = COMMAND"
            raise InputError(f"{ticket.file}: row {whole}, column readings: {what}")
        self.resumed = self._journal.exists()
        if self.resumed:
            self._read_journal()
        elif output.exists():
            raise InputError(f"{output}: exists: a session that is measured is not measured again")
        if expired := self._expired():
            raise InputError(f"{ticket.file}: {expired}: ask for a new one")

    @property
    def folder(self) -> Path:
        """Where recorded traces lie until the session's file holds them."""
        return self.output.with_name(f"{self.output.stem}_traces")

    @property
    def left(self) -> list[int]:
        """Orders that are still to be driven."""
        return [number for number in range(len(self.orders)) if number not in self.outcomes]

    @property
    def last(self) -> Order | None:
        """The order that was driven and kept last."""
        kept = [number for number, outcome in self.outcomes.items() if not outcome["doubt"]]
        return self.orders[kept[-1]] if kept else None

    def begin(self) -> None:
        """Begin the journal, unless an earlier run left one."""
        if not self.resumed:
            self._append(self._head())

    def suggest(self, num_points: int) -> list[dict[str, Any]]:
        """The next points to measure: ``_id``, ``label`` and the joints of start and end as a sweep file has them."""
        points = []
        for number in [number for number in self.left if number not in self._offered][:num_points]:
            order, point = self.orders[number], {"_id": number, "label": self.orders[number].label}
            for end, q in (("start", order.start), ("end", order.targets[-1])):
                for column, x in zip(self.cell.joint_columns, q / self.cell.joint_scales, strict=True):
                    point[column.replace("_", f"_{end}_")] = float(x)
            self._offered.add(number)
            points.append(point)
        return points

    def ingest(self, points: Iterable[Mapping[str, Any]]) -> None:
        """Take what came of points, as `Bench.drive` gives it; on the disk when this returns."""
        for point in points:
            self.outcomes[int(point["_id"])] = dict(point)
            self._disturbed = self._disturbed + 1 if point["doubt"] else 0
            self._append(point)

    def should_stop(self) -> tuple[bool, str]:
        """Whether nothing more is to be measured, and why."""
        if not self.left:
            return True, "all sweeps are driven"
        if self._disturbed >= _MOST_DISTURBED:
            return True, f"{self._disturbed} sweeps in a row are disturbed: {list(self.outcomes.values())[-1]['doubt']}"
        expired = self._expired()
        return (True, expired) if expired else (False, "")

    def checkpoint(self) -> int:
        """Write what was measured, and end the journal once nothing is left; how many rows or traces there are."""
        found: Sweeps | TraceIndex | None
        if isinstance(self.rig.instrument, IDSDevice):
            found = self.sweeps()
            if found is not None:
                doubtful = doubtful_of(self.orders, self.outcomes)
                write_sweeps(self.output, found, self.cell, command=self._command, doubtful=doubtful)
        else:
            found = recordings_of(self.orders, self.outcomes, self.cell, self.folder, self.origin.moment_s)
            if found is not None:
                write_recordings(self.output, found, self.cell)
        if not self.left:
            self._journal.unlink(missing_ok=True)
        return 0 if found is None else len(found)

    def sweeps(self) -> Sweeps | None:
        """The rows so far."""
        sigma = math.sqrt(2.0) * self.rig.instrument.noise if isinstance(self.rig.instrument, IDSDevice) else math.nan
        return sweeps_of(self.orders, self.outcomes, sigma=sigma, origin_s=self.origin.moment_s)

    def _expired(self) -> str:
        now, ticket = self.rig.clock.now(), self.ticket
        if math.isfinite(ticket.expires_utc):
            return f"the ticket expired at {iso(ticket.expires_utc)}" if now > ticket.expires_utc else ""
        if not math.isfinite(ticket.expires_h):
            return ""
        if not self.origin.known and not self.resumed:
            return "the ticket expires at an hour of the campaign, and no campaign with clock times (utc) tells now's"
        hours = (now - self.origin.moment_s) / 3600.0
        return f"the ticket expired at {ticket.expires_h:g} h, now is {hours:.3f} h" if hours > ticket.expires_h else ""

    def _head(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "ticket_sha256": self.ticket.sha256,
            "cell_sha256": self.cell.sha256,
            "rig": self.rig.name,
            "devices": hashlib.sha256(repr(self.rig.measuring).encode()).hexdigest(),
            "origin_s": self.origin.moment_s,
            "origin_known": self.origin.known,
        }

    def _append(self, content: Mapping[str, Any]) -> None:
        line = json.dumps(dict(content), allow_nan=False) + "\n"
        try:
            with self._journal.open("ab") as file:
                file.write(line.encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(f"{self._journal}: cannot be written ({error.strerror})") from error

    def _read_journal(self) -> None:
        """What an earlier run did; a last line that was cut counts for nothing, and is cut off."""
        text = read_text(self._journal)
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            with self._journal.open("rb+") as file:
                file.truncate(len(whole.encode()))
        try:
            head, *outcomes = [json.loads(line) for line in whole.splitlines()] or [{}]
        except ValueError as error:
            raise InputError(f"{self._journal}: damaged ({error}): remove it to begin anew") from error
        own = self._head()
        for name in ("schema", "ticket_sha256", "cell_sha256", "rig", "devices"):
            if head.get(name) != own[name]:
                what = "left by another ticket, cell or rig: remove it to begin anew"
                raise InputError(f"{self._journal}: key {name}: {what}")
        self.origin = Origin(float(head["origin_s"]), bool(head["origin_known"]))
        for outcome in outcomes:
            self.outcomes.pop(outcome["_id"], None)
            self.outcomes[outcome["_id"]] = outcome
        # What was in doubt when the run ended gets another chance.
        self.outcomes = {number: outcome for number, outcome in self.outcomes.items() if not outcome["doubt"]}
