"""A cell is kept calibrated: followed, judged and published, round after round."""

import contextlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fpcal_bayes.analysis.campaign import Followed, follow
from fpcal_bayes.analysis.watch import stamp
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import exclusive, file_sha256, write_json
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.decision.decision import Costs, Decision
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.decision.policy import decide_track, valid_until
from fpcal_bayes.decision.ticket import basis_of, ticket_of
from fpcal_bayes.io.campaign import write_campaign
from fpcal_bayes.io.flat import write_flat
from fpcal_bayes.io.sweeps import is_campaign_file
from fpcal_bayes.io.tickets import read_ticket, write_ticket
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.ticket import Ticket, empty_ticket
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA
from fpcal_bayes.motion.flat import flat_content
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.record import record_of
from fpcal_bayes.tracking.sessions import hours_of
from fpcal_bayes.tracking.tracker import Track


def follow_saved(file: str | Path, cell: Cell, *, now: str | float | None = None, anew: bool = False) -> Followed:
    """As `follow`; the states are saved in the campaign, if it is an HDF5 file, under the lock of its writers."""
    with contextlib.ExitStack() as alone:
        # Two that save their states in one campaign would each lose what the other found.
        if is_campaign_file(file):
            alone.enter_context(exclusive(Path(file)))
        followed = follow(file, cell, now=now, anew=anew)
        found, notes = followed.track, followed.notes
        if followed.campaign is None or found.resumed == len(found.outcomes):
            return followed
        try:
            write_campaign(file, replace(followed.campaign, track=record_of(found, followed.sweeps, Limits())), cell)
        except InputError as error:
            notes.append(f"the states are not saved: {error}")
        return replace(followed, track=replace(found, data=found.data | {"sha256": file_sha256(Path(file))}))


def published(found: Track, valid_until_h: float | None) -> dict[str, Any]:
    """The current best estimate as JSON, with its fit and the verdict of its last session."""
    fit = {"n_sweeps": sum(o.n_sweeps for o in found.outcomes), "nis": found.last.nis, "converged": found.converged}
    said = {"verdict": found.last.verdict, "calibration_due": found.calibration_due is not None}
    return found.estimate(valid_until_h).content() | {"fit": fit} | said


@dataclass(frozen=True)
class Outputs:
    """Files that a round replaces, each in one step."""

    estimate: Path
    ticket: Path
    flat: Path | None = None


@dataclass(frozen=True)
class Round:
    """What a round found."""

    followed: Followed
    now_h: float
    valid_until_h: float | None
    decision: Decision | None  # None where nothing can be decided
    ticket: Ticket  # as it stands in the file now
    notes: tuple[str, ...]


@dataclass
class Keeper:
    """Follows a campaign, decides and publishes, as often as it is asked to; `now` tells Unix time.

    While the campaign stays as it is, what was found of it is not worked out or published again, and a decision to hold
    stands until its end.
    """

    campaign: str | Path
    cell: Cell
    goal: Goal
    costs: Callable[[Sweeps], Costs]
    outputs: Outputs
    now: Callable[[], float]
    _followed: tuple[float, Followed | None] = 0.0, None
    _held: Decision | None = None
    # Until when the estimate holds, and what is to be said of that; and what was published.
    _until: tuple[float | None, list[str]] | None = None
    _published: tuple[list[str], list[object], float] | None = None

    def round(self) -> Round:
        """Follow, decide, publish; `InputError` if the campaign cannot be read or followed."""
        goal, moment = self.goal, self.now()
        followed = self._follow(moment)
        found, sweeps, notes = followed.track, followed.sweeps, list(followed.notes)
        began = self._began(found, moment)
        since_h = hours_of(iso(moment), sweeps) if (sweeps.utc != "").any() else (moment - began) / 3600.0
        now_h = max(found.last.time_h, since_h)
        if self._until is None:
            self._until = self._valid_until(found)
        until_h, doubts = self._until
        notes += doubts
        decision = self._held
        try:
            if decision is None or not decision.now_h <= now_h < decision.now_h + decision.hold_hours:
                decision = self._held = None
                decision = decide_track(found, sweeps, goal, self.costs(sweeps), now_h)
                self._held = decision if decision.action == "hold" else None
            stuck = decision.action == "hold" and not found.trust.usable
            notes += [decision.reason] if stuck or decision.attainable_nm is not None else []
        except InputError as error:
            notes.append(f"nothing is decided: {error}")
        if self._published is None or self._published[:2] != (notes, self._stamps()):
            self._publish(found, until_h, notes, began)
            self._published = notes, self._stamps(), began
        return Round(followed, now_h, until_h, decision, self._issue(decision, sweeps, moment), tuple(notes))

    def withdraw(self) -> None:
        """Empty the ticket: what it rests on is in doubt."""
        self._write(empty_ticket(str(self.outputs.ticket)), self._pending())

    def _follow(self, moment: float) -> Followed:
        path, (before, known) = Path(self.campaign), self._followed
        same = known is not None and before <= moment and path.is_file()
        if known is None or not same or file_sha256(path) != known.track.data["sha256"]:
            self._held = self._until = self._published = None
            known = follow_saved(path, self.cell, now=moment)
        self._followed = moment, known
        return known

    def _issue(self, decision: Decision | None, sweeps: Sweeps, moment: float) -> Ticket:
        """Write the decision's ticket, unless one that rests on the same campaign is being measured."""
        path, pending = self.outputs.ticket, self._pending()
        if decision is not None and pending is not None and pending.plan is not None:
            fresh = pending.name.startswith(f"{basis_of(sweeps)}-") and moment < pending.expires_utc
            if fresh and str(pending.plan.session[0]) not in sweeps.sessions:
                return pending
        name = str(path)
        ticket = empty_ticket(name) if decision is None else ticket_of(decision, sweeps, name, now_utc=moment)
        self._write(ticket, pending)
        return ticket

    def _write(self, ticket: Ticket, pending: Ticket | None) -> None:
        if pending is None or pending.plan is not None or ticket.plan is not None:
            write_ticket(self.outputs.ticket, ticket, self.cell)

    def _pending(self) -> Ticket | None:
        """The ticket that is there, or None if none can be read."""
        try:
            return read_ticket(self.outputs.ticket, self.cell)
        except InputError:
            return None

    def _began(self, found: Track, moment: float) -> float:
        """Unix time at which the campaign began, by when its sessions were first seen; the last estimate remembers."""
        # A session is seen when it was measured or later, so that the earliest guess is the nearest.
        guess = moment - 3600.0 * found.last.time_h
        if self._published is not None and self._published[1] == self._stamps():
            return min(guess, self._published[2])
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            before: Mapping[str, Any] = json.loads(self.outputs.estimate.read_text(encoding="utf-8"))
            if before["calibration_session"] == found.outcomes[0].session:
                return min(guess, clock(before["campaign_began_utc"]).timestamp())
        return guess

    def _publish(self, found: Track, until_h: float | None, notes: list[str], began: float) -> None:
        remembered = {"calibration_session": found.outcomes[0].session, "campaign_began_utc": iso(began)}
        content = published(found, until_h) | {"warnings": notes} | remembered
        write_json(self.outputs.estimate, {"schema": SCHEMA, "command": "track", **content})
        if self.outputs.flat is not None:
            estimate = found.estimate(until_h)
            if not estimate.data.get("utc"):
                estimate = replace(estimate, data=estimate.data | {"utc": iso(began + 3600.0 * estimate.time_h)})
            write_flat(self.outputs.flat, flat_content(estimate))

    def _stamps(self) -> list[object]:
        return [stamp(path) for path in (self.outputs.estimate, self.outputs.flat) if path is not None]

    def _valid_until(self, found: Track) -> tuple[float | None, list[str]]:
        """Hours until which the estimate holds, or None, and what is to be said of it."""
        try:
            return valid_until(found, self.goal) if found.trust.usable else None, []
        except InputError as error:
            return None, [f"how long the estimate holds cannot be said: {error}"]
