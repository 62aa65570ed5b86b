"""What is served: the files as they are when they are asked for, and what is worked out from them."""

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from fpcal_bayes.analysis.append import append
from fpcal_bayes.analysis.campaign import Followed, follow, gather
from fpcal_bayes.analysis.watch import stamp
from fpcal_bayes.cli.decide import decided
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import CONTENT_HASH, content_sha256, read_text
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.decision.policy import suggest_sweeps
from fpcal_bayes.infer.tasks.source import Knowledge, read_knowledge
from fpcal_bayes.io.sweeps import read_csv
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import no_envelope_text, require_task_within_envelope
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.inverse import check_poses
from fpcal_bayes.model.trust import Reason
from fpcal_bayes.motion.compensation import compensated
from fpcal_bayes.motion.controller import Controller, checked_joints
from fpcal_bayes.motion.flat import flat_content
from fpcal_bayes.motion.placement import Placement
from fpcal_bayes.motion.tasks import TASKS, Task, follow_offsets
from fpcal_bayes.motion.validity import hours_of_estimate, judged_at
from fpcal_bayes.report.campaign.page import campaign_html
from fpcal_bayes.report.tasks import known, reach_warnings
from fpcal_bayes.report.track import sweeps_content
from fpcal_bayes.tracking.sessions import hours_at

#: Poses of a request.
MOST_POSES = 5000
#: What is held against an estimate whose horizon cannot be held against a clock.
_NO_CLOCK = Reason("stale", "the estimate carries no clock time: whether it is out of date cannot be told")


class RefusedError(InputError):
    """Joints are refused; `despite` is what a request repeats to have them all the same."""

    def __init__(self, despite: str) -> None:
        super().__init__(f"the estimate is not to be driven with: {despite}")
        self.despite = despite


class StateError(InputError):
    """Not the request but the files on this side cannot be used."""


@dataclass(frozen=True)
class Files:
    """What is read; sweeps are added to the campaign."""

    campaign: Path
    estimate: Path
    ticket: Path | None = None


_Number = Annotated[float, Field(ge=-1e7, le=1e7, allow_inf_nan=False)]
_Six = Annotated[list[_Number], Field(min_length=6, max_length=6)]
_Row = Annotated[list[_Number], Field(min_length=4, max_length=4)]
_Pose = Annotated[list[_Row], Field(min_length=4, max_length=4)]


class Asked(BaseModel, strict=True, extra="forbid"):
    """A path that joints are asked for: poses, or a task by name."""

    poses: Annotated[list[_Six | _Pose], Field(min_length=1, max_length=MOST_POSES)] | None = Field(
        None, description="x_um, y_um, z_um, rx_deg, ry_deg, rz_deg from the aligned pose, or fX as four rows of four"
    )
    task: Annotated[str, Field(max_length=100)] | None = None
    radius_um: Annotated[float, Field(gt=1e-9, le=1e7, allow_inf_nan=False)] | None = None
    points: Annotated[int, Field(ge=2, le=MOST_POSES)] | None = None
    q_now: Annotated[list[_Number], Field(max_length=6)] | None = Field(
        None, description="where the joints stand, um and deg (default: all at zero)"
    )
    compensate: bool = True
    despite: str = Field("", description="the reason of a refusal, word by word, to have joints all the same")


@dataclass
class _Current:
    """An estimate file as it was read."""

    content: dict[str, Any]
    knowledge: Knowledge
    estimate: Estimate
    controller: Controller
    warnings: list[str]  # about the envelope
    answers: dict[tuple[bool, bool], tuple[dict[str, Any], str]]  # worked out already, by form and verdict
    prepared: bool = False

    @classmethod
    def read(cls, path: Path, cell: Cell) -> "_Current":
        text = read_text(path)
        knowledge = read_knowledge(path, cell, text=text)
        content, estimate = json.loads(text), knowledge.estimate
        assert estimate is not None
        began = content.get("campaign_began_utc")
        if began and not estimate.data.get("utc"):
            utc = iso(clock(began).timestamp() + 3600.0 * estimate.time_h)
            estimate = replace(estimate, data=estimate.data | {"utc": utc})
        controller = Controller(estimate, accept_untrusted=True)
        return cls(content, knowledge, estimate, controller, no_envelope_text(*knowledge.drawn(estimate)), {})

    def prepare(self) -> None:
        """Work out in which ranges of the joints no single move needs a closer look."""
        if not self.prepared:
            self.controller.require_within(self.controller.q[None])
            self.prepared = True

    def judged(self, now: float) -> Estimate:
        """The estimate with what its age holds against it."""
        now_h = hours_of_estimate(self.estimate, datetime.fromtimestamp(now, UTC))
        found = judged_at(self.estimate, now_h)
        if now_h is None and found.valid_until_h is not None:
            found = replace(found, trust=found.trust.because(_NO_CLOCK))
        return found


class Served:
    """Answers about one cell; `now` gives Unix time."""

    def __init__(
        self, files: Files, cell: Cell, goal: Goal, costs: Callable[[Sweeps], Costs], now: Callable[[], float]
    ) -> None:
        self.files, self.cell = files, cell
        self._goal, self._costs, self.now = goal, costs, now
        self._lock = threading.Lock()
        self._read: tuple[object, _Current] | None = None
        self._known: tuple[object, Followed] | None = None

    def current(self) -> _Current:
        """The estimate as its file stands now; `StateError` if it cannot be used."""
        with self._lock:
            seen = stamp(self.files.estimate)
            if self._read is None or self._read[0] != seen:
                try:
                    self._read = seen, _Current.read(self.files.estimate, self.cell)
                except InputError as error:
                    raise StateError(str(error)) from error
            return self._read[1]

    def estimate(self, flat: bool = False) -> tuple[dict[str, Any], str]:
        """The estimate file with the verdict of now, or its flat names; each with its hash, and as JSON."""
        current = self.current()
        judged = current.judged(self.now())
        key = flat, judged.trust.usable
        if key not in current.answers:
            content = flat_content(judged)
            if not flat:
                said = judged.content()
                until = {"valid_until_utc": (said["valid_until_h"] and content["valid_until_utc"]) or None}
                content = current.content | {key: said[key] for key in ("trust", "valid_until_h")} | until
                del content[CONTENT_HASH]
            content[CONTENT_HASH] = content_sha256(content)
            current.answers[key] = content, json.dumps(content)
        return current.answers[key]

    def joints(self, asked: Asked) -> dict[str, Any]:
        """Joints of a path and their predicted error; `RefusedError` where the estimate may not be used."""
        current = self.current()
        estimate, cell = current.judged(self.now()), self.cell
        trust = estimate.trust
        if not trust.usable and asked.despite != trust.against:
            raise RefusedError(trust.against)
        start = None
        if asked.q_now is not None:
            # A list of another length is refused as it is.
            start = checked_joints(cell, np.array(asked.q_now) * np.resize(cell.joint_scales, len(asked.q_now)))
        task = self._path(current, asked, start)
        q = task.q[task.ok]
        if len(q) == 1 and current.prepared:
            current.controller.require_within(q, start)
        else:
            model, draws = current.knowledge.drawn(current.estimate)
            require_task_within_envelope(model, draws, q, name=task.name, start=start)
        sd = np.full(len(task), np.nan)
        if trust.usable and len(q):
            sd[task.ok] = 1e3 * current.knowledge.sd(estimate, task.driven())
        shown = np.where(task.ok[:, None], task.q / cell.joint_scales, np.nan)
        return {
            "task": task.name,
            "joint_names": list(cell.joint_columns),
            "q": [row if good else None for row, good in zip(shown.tolist(), task.ok, strict=True)],
            "status": task.status.tolist(),
            "predicted_sd_nm": list(map(known, sd.tolist())),
            "estimate": self.estimate()[0][CONTENT_HASH],
            "trust": trust.content(),
            "warnings": [*current.warnings, *reach_warnings(task), *trust.texts],
        }

    def decision(self) -> dict[str, Any]:
        """What to do now, as ``fpcal decide --json`` says it; the estimate itself is not repeated."""
        found = self._followed()
        _, content = decided(found, self._goal, self._costs(found.sweeps), self._hours(found.sweeps))
        return content

    def suggest(self, n: int) -> dict[str, Any]:
        """The next `n` sweeps that tell most, whether they are due or not, under the names of a plan's columns."""
        found = self._followed()
        now_h = self._hours(found.sweeps)
        chosen = suggest_sweeps(found.track, found.sweeps, self._goal, self._costs(found.sweeps), now_h, n)
        return {"now_h": now_h, "sweeps": sweeps_content(chosen, self.cell)}

    def report(self) -> str:
        """The page of ``fpcal report`` as of now."""
        now_h = self._hours(self._followed().sweeps)
        return campaign_html(gather(self.files.campaign, self.cell, goal=self._goal, now=f"{now_h:.6f}"))

    def append(self, text: str) -> dict[str, Any]:
        """Add a measured session to the campaign, as ``fpcal append`` does."""
        sweeps = read_csv("sweeps", self.cell, text=text)
        done = append(self.files.campaign, sweeps, self.cell, ticket=self.files.ticket, now=self.now())
        return {"sessions": list(done.sessions), "n_rows": done.n_rows, "n_missing": done.n_missing}

    def _path(self, current: _Current, asked: Asked, start: Floats | None) -> Task:
        """The path that was asked for, found with the estimate."""
        if (asked.poses is None) == (asked.task is None):
            raise InputError("expected poses or a task, one of the two")
        if asked.task is not None:
            names = (*TASKS, *(task.name for task in self.cell.tasks))
            if asked.task not in names:
                raise InputError(f"unknown task {asked.task[:40]!r}: expected one of {', '.join(names)}")
            _, task = current.knowledge.plan(
                asked.task, radius=asked.radius_um, n_points=asked.points, compensate=asked.compensate
            )
            return task
        vector, poses = current.estimate.vector(), asked.poses or []
        if {len(pose) for pose in poses} == {4}:
            check_poses(poses)
            offsets = Placement.of(self.cell, vector).offsets(np.array(poses))
        elif {len(pose) for pose in poses} == {6}:
            offsets = np.array(poses) * np.repeat([1.0, np.pi / 180.0], 3)
        else:
            raise InputError("poses: expected all of one form, six numbers or four rows of four")
        task = follow_offsets(self.cell, vector, "poses", offsets, start)
        plain = current.knowledge.draws is not None or not asked.compensate
        return task if plain else compensated(current.estimate, task, start)

    def _followed(self) -> Followed:
        """The campaign followed to its end; anew when its file has changed."""
        seen = stamp(self.files.campaign)
        if self._known is None or self._known[0] != seen:
            self._known = seen, follow(self.files.campaign, self.cell, now=self.now())
        return self._known[1]

    def _hours(self, sweeps: Sweeps) -> float:
        """Now in hours since the campaign began; where rows carry no clock times, as `fpcal keep` counts them."""
        last_h, now_h = float(sweeps.time_h.max()), hours_at(self.now(), sweeps)
        if now_h is None:
            try:
                now_h = (self.now() - clock(self.current().content["campaign_began_utc"]).timestamp()) / 3600.0
            except (KeyError, StateError):
                now_h = last_h
        return max(now_h, last_h)
