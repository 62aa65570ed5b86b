"""The devices of a cell under one hand: go to a pose, read the length, drive an order, stop."""

import contextlib
import math
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import HeldError, InputError
from fpcal_bayes.core.files import exclusive
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.traces import write_trace
from fpcal_bayes.measure.ticket import Order
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.rig.clock import Halt
from fpcal_bayes.rig.drivers.attocube import AttocubeIDS
from fpcal_bayes.rig.drivers.interface import CommandLog, DeviceError, Disturbed, Interferometer, Stage
from fpcal_bayes.rig.drivers.link import Link
from fpcal_bayes.rig.drivers.photodiode import PhotodiodeProgram
from fpcal_bayes.rig.drivers.pi import PIStage
from fpcal_bayes.rig.drivers.smaract import SmarActStage
from fpcal_bayes.rig.route import Guard
from fpcal_bayes.rig.settings import ControllerSettings, IDSDevice, Rig

#: Longest and shortest pause between two looks at the devices, in s of the wall.
_LONGEST_PAUSE, _SHORTEST_PAUSE = 0.01, 0.0005
#: How long the axes may take to stand still after a stop, in s of the wall.
_STOP_S = 2.0
#: An emulated clock runs on while this program waits for a core: no move fails sooner, in s of the wall.
_PATIENCE_S = 1.0


@dataclass(frozen=True)
class Reading:
    """The length at one pose."""

    q: Floats  # joint values read back, in um and rad, shape (n_joints,)
    length: float  # in um, up to a constant; NaN where a program records
    moment: float  # Unix time of the cell
    temperature_c: float  # or NaN


class Bench:
    """All devices of a rig; a recording program writes its traces into `folder`."""

    def __init__(self, cell: Cell, rig: Rig, guard: Guard, halt: Halt, log: CommandLog, folder: Path) -> None:
        self._cell = cell
        self._rig = rig
        self._guard = guard
        self._halt = halt
        self._links: list[Link] = []
        self._log = log
        self.stages: list[Stage] = [self._stage(controller) for controller in rig.controllers]
        self.instrument: Interferometer | None = None
        self.recorder: PhotodiodeProgram | None = None
        device = rig.instrument
        if isinstance(device, IDSDevice):
            self.instrument = AttocubeIDS(self._link(device.name, device), device.settings)
        else:
            self.recorder = PhotodiodeProgram(device.command, folder, device.timeout_s, halt, log)
        self._folder = folder
        self._commanded = np.full(len(cell.joints), np.nan)
        self._moved = False
        # The order that was driven and kept last, and whether the joints have returned to its start and stand there.
        self.before: Order | None = None
        self._returned = False

    def prepare(self) -> None:
        """Connect to all devices, stop axes that were left on their way; hold all to what moves and readings need."""
        for stage in self.stages:
            stage.prepare()
            if self._moves(stage):
                raise InputError(f"{stage.name}: its axes do not stop")
        if self.instrument is not None:
            try:
                self.instrument.prepare()
            except Disturbed as error:
                raise InputError(f"{self.instrument.name}: {error}: align it, then start again") from error
        self._guard.check_pose(self.position(), "the cell as it stands")

    def position(self) -> Floats:
        """Joint values read back, in um and rad, shape (n_joints,)."""
        q = np.empty(len(self._cell.joints))
        for stage in self.stages:
            q[list(stage.joints)] = stage.position()
        if not np.isfinite(q).all():
            raise InputError("a controller shows a position that is no number")
        return q

    def go(self, target: Floats, what: str, *, watch: bool = False) -> Floats:
        """Move to a pose and hold it; joint values read back. With `watch`, `Disturbed` there if fringes were lost."""
        self._log.check()
        here = self.position()
        # Where the joints were sent they stand; the encoders' last digits are no motion.
        here = np.where(np.abs(here - self._commanded) <= self._guard.tolerance, self._commanded, here)
        self._guard.check_move(here, target, what)
        lost = ""
        for pose in self._guard.turns(here, target):
            lost = self._turn(here, pose, what, watch and not lost) or lost
        if lost:
            raise Disturbed(lost)
        return self.position()

    def _turn(self, here: Floats, target: Floats, what: str, watch: bool) -> str:
        """Move joints that may move at once; why the fringes were lost on the way, or nothing."""
        moving = self._commanded != target
        seconds = self._guard.seconds(here, target)
        allowed = seconds + max((self._rig.joints[i].settle_timeout_s for i in np.flatnonzero(moving)), default=0.0)
        stages = [stage for stage in self.stages if moving[list(stage.joints)].any()]
        self._commanded[:] = np.nan
        self._moved = self._moved or bool(stages)
        for stage in stages:
            stage.move(target[list(stage.joints)])
        lost = self._wait(target, stages, seconds, allowed, what, watch)
        self._commanded = target.copy()
        return lost

    def _wait(self, target: Floats, stages: list[Stage], seconds: float, allowed: float, what: str, watch: bool) -> str:
        """Wait until the joints stand at `target`; why the fringes were lost on the way, or nothing."""
        clock, lost = self._rig.clock, ""
        began, wall, since = clock.ticks(), time.monotonic(), math.inf
        hold = max((self._rig.joints[i].settle_s for stage in stages for i in stage.joints), default=0.0)
        while True:
            # Every controller is asked, so that a failure is seen at once.
            settled = not [stage for stage in stages if not stage.settled()]
            q = self.position()
            self._guard.check_pose(q, f"{what}, on the way")
            if watch and not lost:
                lost = self._lost()
            now = clock.ticks()
            away = np.abs(q - target) > self._guard.tolerance
            if settled and not away.any():
                since = min(since, now)
                if now - since >= hold:
                    return lost
            else:
                since = math.inf
            late = time.monotonic() - wall > min(_PATIENCE_S, allowed)
            if late and now - began > allowed:
                raise self._unsettled(target, q, away, now - began)
            pause = clock.wall(max(began + 0.5 * seconds, since + hold if since < math.inf else 0.0) - now)
            self._halt.wait(min(max(pause, _SHORTEST_PAUSE), _LONGEST_PAUSE))

    def _lost(self) -> str:
        try:
            if self.instrument is not None:
                self.instrument.watch()
        except Disturbed as error:
            return str(error)
        return ""

    def _unsettled(self, target: Floats, q: Floats, away: np.ndarray[Any, np.dtype[np.bool_]], s: float) -> DeviceError:
        i = int(np.argmax(away)) if away.any() else int(np.argmax(np.abs(q - target) / self._guard.tolerance))
        joint, scale, axis = self._cell.joints[i], self._cell.joint_scales[i], self._rig.joints[i].axis
        stands = f"q{i + 1} stands at {q[i] / scale:.9g} {joint.unit} after {s:.3g} s"
        address = next(each.address for each in self._rig.controllers if each.name == axis.name)
        return DeviceError(axis.name, address, f"move q{i + 1} to {target[i] / scale:.9g}", f"not settled: {stands}")

    def read(self, target: Floats) -> Reading:
        """Read positions and length at rest, at `target`; `Disturbed` if these do not stand still."""
        before = self.position()
        away = np.abs(before - target) > self._guard.tolerance
        if away.any():
            raise self._unsettled(target, before, away, 0.0)
        length = math.nan if self.instrument is None else self.instrument.length()
        moment = self._rig.clock.now()
        celsius = math.nan if self.instrument is None else self.instrument.temperature_c()
        if (np.abs(self.position() - before) > self._guard.tolerance).any():
            raise Disturbed("the joints moved while the length was read")
        return Reading(before, length, moment, celsius)

    def drive(self, number: int, order: Order) -> dict[str, Any]:
        """Drive an order, again if it is disturbed, and then with a ``doubt``; what came of it for `Agenda.ingest`."""
        doubt, closing = "", math.nan
        for attempt in range(self._rig.repeats + 1):
            self._await_fringes()
            try:
                if self.recorder is not None:
                    return self._record(number, order)
                readings = self._sweep(order)
            except Disturbed as error:
                doubt, closing = str(error), math.nan
            else:
                closing = readings[-1].length - readings[0].length
                if abs(closing) <= self._rig.close:
                    self.before, self._returned = order, True
                    return _outcome(number, readings[:-1], closing)
                doubt = f"does not close: {1e3 * closing:.1f} nm between the start and the return to it"
            self._log.write("measure", "-", f"{order.label}: {doubt} (drive {attempt + 1})")
        return _outcome(number, [], closing) | {"doubt": doubt}

    def _sweep(self, order: Order) -> list[Reading]:
        readings = []
        self._run_up(order)
        for number, target in enumerate(self._guard.stops(order)):
            # On the way to the start nothing is measured yet.
            self.go(target, f"row {order.row}: {order.label!r}", watch=number > 0)
            readings.append(self.read(target))
        if any(later.moment < earlier.moment for earlier, later in pairwise(readings)):
            raise Disturbed("the computer's clock was set back")
        return readings

    def _run_up(self, order: Order) -> None:
        """Come to the start of an order from the side that the order of the rows says."""
        for pose in self._guard.run_up(order, self.before, returned=self._returned):
            self.go(pose, f"row {order.row}: {order.label!r}, before the start")
        self._returned = False

    def _record(self, number: int, order: Order) -> dict[str, Any]:
        if self.recorder is None:
            raise InputError("no program records, expected one")
        what = f"row {order.row}: {order.label!r}"
        start, *_, end, _ = self._guard.stops(order)
        joints = np.flatnonzero(order.start != order.targets[-1])
        if len(joints) != 1:
            raise InputError(f"{what}: {len(joints)} joints move, expected one: a trace holds one")
        joint = int(joints[0])
        scale = float(self._cell.joint_scales[joint])
        self._run_up(order)
        self.go(start, what)
        first = self.read(start)
        seconds = self._guard.seconds(start, end) + self._rig.joints[joint].settle_timeout_s
        try:
            self.recorder.start(seconds, joint, start[joint] / scale, end[joint] / scale)
            self.go(end, what)
            trace = self.recorder.finish(scale)
        finally:
            self.recorder.abandon()
        last = self.read(end)
        ends = np.array([trace.joint[0] - first.q[joint], trace.joint[-1] - last.q[joint]])
        if (np.abs(ends) > 10.0 * self._guard.tolerance[joint]).any():
            raise Disturbed("the trace does not begin and end where the joint stood")
        path = self._folder / f"{number + 1:04d}_kept.csv"
        write_trace(path, trace, scale)
        self.go(start, what)
        self.before, self._returned = order, True
        return _outcome(number, [first, last], math.nan) | {"trace": path.name}

    def _await_fringes(self) -> None:
        """Give lost fringes as long as an axis has to settle to come back."""
        clock = self._rig.clock
        end = clock.ticks() + max(joint.settle_timeout_s for joint in self._rig.joints)
        while self._lost() and clock.ticks() < end:
            self._halt.wait(_LONGEST_PAUSE)

    def stop(self) -> list[str]:
        """Stop all axes, then make sure that they stand; what could not be made sure of, if anything was moved.

        The stops go out first, to all controllers, without waiting for any of them; then each is asked over a
        connection of its own, so that no answer of an exchange that was cut is taken for another.
        """
        for stage in self.stages:
            stage.stop()
        if self.recorder is not None:
            self.recorder.abandon()
        self._commanded[:] = np.nan
        for link in self._links:
            link.obeys = False
        doubts = []
        for stage in self.stages:
            try:
                why = self._moves(stage)
            except DeviceError as error:
                why = str(error)
            if why:
                doubts.append(f"{stage.name}: not sure that its axes stand ({why})")
        for link in self._links:
            link.obeys = True
        return doubts if self._moved else []

    @staticmethod
    def _moves(stage: Stage) -> str:
        """Wait until the axes of a controller stand; what is said if they do not."""
        end = time.monotonic() + _STOP_S
        while not stage.stopped():
            if time.monotonic() > end:
                return "it moves"
            time.sleep(_SHORTEST_PAUSE)
        return ""

    def close(self) -> None:
        """Let go of all connections."""
        for link in self._links:
            link.close()

    def _link(self, name: str, device: Any) -> Link:
        self._links.append(Link(name, device.address, device.timeout_s, self._halt, self._log))
        return self._links[-1]

    def _stage(self, settings: ControllerSettings) -> Stage:
        joints = tuple(i for i, joint in enumerate(self._rig.joints) if joint.axis.name == settings.name)
        axes = tuple(self._rig.joints[i].axis for i in joints)
        speeds = np.array([self._rig.joints[i].speed for i in joints])
        link = self._link(settings.name, settings)
        if settings.driver == "pi-gcs2":
            return PIStage(link, joints, axes, speeds, settings.servo_on)
        return SmarActStage(link, joints, axes, speeds, self._cell.revolute[list(joints)])


@contextlib.contextmanager
def only_one(rig: Rig) -> Iterator[None]:
    """Hold the controllers of a rig against others on this computer, which would stop its axes; or `InputError`."""
    with contextlib.ExitStack() as held:
        for controller in rig.controllers:
            path = Path(tempfile.gettempdir()) / f"fpcal-{controller.address}.lock".replace(":", "-")
            os.close(os.open(path, os.O_CREAT | os.O_RDONLY, 0o644))
            try:
                held.enter_context(exclusive(path, in_place=True))
            except HeldError as error:
                what = "another fpcal drives it: wait until it has ended"
                raise InputError(f"{controller.name} at {controller.address}: {what}") from error
        yield


def _outcome(number: int, readings: list[Reading], closing: float) -> dict[str, Any]:
    def told(value: float) -> float | None:
        return value if math.isfinite(value) else None

    read = [
        {
            "q": reading.q.tolist(),
            "length_um": told(reading.length),
            "moment_s": reading.moment,
            "temperature_c": told(reading.temperature_c),
        }
        for reading in readings
    ]
    return {"_id": number, "doubt": "", "closing_um": told(closing), "readings": read}
