"""One simulated cell behind all emulated devices: axes that take time, a mirror, a cavity that drifts."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.rig.clock import Clock
from fpcal_bayes.simulator.machine import Machine

#: How far an axis rings at its target before it has settled, as a share of its speed in um or rad a second.
_RINGING = 1e-3


@dataclass
class Axis:
    """One joint on its way; positions in um or rad, times in s of the cell."""

    speed: float
    settle_s: float
    start: float = 0.0
    target: float = 0.0
    began: float = 0.0
    #: Where it is held by a fault, or NaN.
    stuck: float = float("nan")
    closed_loop: bool = True
    offset: float = 0.0
    approach: float = 0.0

    def arrival(self) -> float:
        """When it gets to its target."""
        return self.began + abs(self.target - self.start) / self.speed

    def at(self, now: float) -> float:
        """Where it is."""
        if self.stuck == self.stuck:
            return self.stuck
        left = self.arrival() - now
        way = self.target - self.start
        if left > 0.0:
            return self.target - float(np.sign(way)) * left * self.speed
        if way == 0.0 or self.settle_s <= 0.0 or -left >= self.settle_s:
            return self.target
        # Rings out from short of the target; never beyond it.
        short = min(_RINGING * self.speed, abs(way)) * (1.0 + left / self.settle_s)
        return self.target - float(np.sign(way)) * short

    def moving(self, now: float) -> bool:
        """Whether it is on its way."""
        return self.stuck != self.stuck and now < self.arrival()

    def settled(self, now: float) -> bool:
        """Whether it stands on its target."""
        return self.stuck != self.stuck and self.closed_loop and now >= self.arrival() + self.settle_s


class SimulatedCell:
    """A cell with a truth through time, as its devices see it; `noise` is the sd of one reading of length, in um."""

    def __init__(
        self,
        cell: Cell,
        truth: Truth,
        clock: Clock,
        *,
        noise: float,
        settle_s: float = 0.05,
        seed: int = 0,
        time_h: float = 0.0,
        machine: Machine | None = None,
    ) -> None:
        self.cell = cell
        self.truth = truth
        self.clock = clock
        self.machine = machine
        self.axes = [Axis(1.0, settle_s) for _ in cell.joints]
        #: Targets that were asked for, and whether each lay within the joint's limits.
        self.commanded: list[tuple[int, float, bool]] = []
        #: Half wavelengths that the interferometer has lost, and its contrast in permille.
        self.slipped = 0
        self.contrast = 500.0
        self.zero = 0.0
        self.settle_s = settle_s
        self._began = clock.now()
        self._time_h = time_h
        self._noise = noise
        self._random = np.random.default_rng(seed)
        self._model = CavityModel.of(cell, truth.parameters)

    def time_h(self) -> float:
        """Hours of the campaign, now."""
        return self._time_h + (self.clock.now() - self._began) / 3600.0

    def move(self, joint: int, target: float) -> bool:
        """Begin to move a joint; False, and no motion, if its limits forbid it."""
        axis, now, stated = self.axes[joint], self.clock.now(), self.cell.joints[joint]
        slack = 1e-9 * (1.0 + abs(target))
        allowed = stated.low - slack <= target <= stated.high + slack
        self.commanded.append((joint, target, allowed))
        if not allowed:
            return False
        axis.start, axis.began, axis.target = axis.at(now), now, target
        if target != axis.start:
            axis.approach = float(np.sign(target - axis.start))
            spread = stated.repeatability if self.machine is None else float(self.machine.return_sd[joint])
            axis.offset = spread * float(self._random.standard_normal())
        return True

    def stop(self, joint: int) -> None:
        """Stop a joint where it is."""
        axis, now = self.axes[joint], self.clock.now()
        if axis.moving(now):
            axis.start, axis.target, axis.began = axis.at(now), axis.at(now), now

    def position(self, joint: int) -> float:
        """What a joint's encoder shows, in um or rad."""
        noise = self.cell.joints[joint].resolution * float(self._random.standard_normal())
        return self.axes[joint].at(self.clock.now()) + noise

    def settled(self, joint: int) -> bool:
        """Whether a joint stands on its target."""
        return self.axes[joint].settled(self.clock.now())

    def hold(self, joint: int) -> None:
        """A joint gets no further than it is, until it is released."""
        axis = self.axes[joint]
        axis.stuck = axis.at(self.clock.now())

    def release(self, joint: int) -> None:
        """A held joint is free again, at rest where it is."""
        axis = self.axes[joint]
        if axis.stuck == axis.stuck:
            axis.start = axis.target = axis.stuck
            axis.began = self.clock.now()
        axis.stuck, axis.closed_loop = float("nan"), True

    def length(self) -> float:
        """True cavity length now, in um."""
        now, time_h = self.clock.now(), self.time_h()
        q = np.array([axis.at(now) + axis.offset for axis in self.axes])
        found = float(self._model.predict(self.truth.at(time_h), self._model.pose_rows(q[None]))[0])
        if self.machine is not None:
            found += self.machine.length_change(q, np.array([axis.approach for axis in self.axes]), time_h)
        return found

    def reading(self) -> float:
        """One position as the interferometer counts it, in um."""
        lost = self.slipped * self.cell.wavelength / 2.0
        return self.length() - self.zero + lost + self._noise * float(self._random.standard_normal())


class EmulatedController:
    """Joints of the cell behind a motion controller, by its channels."""

    def __init__(self, lab: SimulatedCell, axes: dict[int, ControllerAxis]) -> None:
        self._lab = lab
        self._joints = {axis.channel: joint for joint, axis in axes.items()}
        self._axes = {axis.channel: axis for axis in axes.values()}
        #: Times of the cell at which a stop came in.
        self.stops: list[float] = []

    def fault(self, kind: str, active: bool) -> None:
        """The joints are hindered, or free again."""
        for channel, joint in self._joints.items():
            if kind == "slow-settling":
                self._lab.axes[joint].settle_s = (1e3 if active else 1.0) * self._lab.settle_s
                continue
            if active:
                self._lab.hold(joint)
            else:
                self._lab.release(joint)
            self._suffer(channel, kind, active)

    def _suffer(self, channel: str, kind: str, active: bool) -> None:
        """What the controller itself shows of a fault."""


def next_line(buffer: bytearray) -> str | None:
    """Take a whole line from the buffer's beginning; None where its end has not come."""
    line, end, _ = buffer.partition(b"\n")
    if not end:
        return None
    del buffer[: len(line) + 1]
    return line.decode("latin-1").strip()
