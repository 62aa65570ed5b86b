"""SmarAct MCS2 by its ASCII protocol: lines that end in CRLF, lengths in pm, angles in ndeg."""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.rig.drivers.link import Link

DEFAULT_PORT = 55551

_END = "\r\n"
#: um and rad of the unit on the wire, pm or ndeg.
_PM, _NDEG = 1e-6, math.radians(1e-9)

_MOVING, _CLOSED_LOOP, _CALIBRATED, _REFERENCED = 0x1, 0x2, 0x40, 0x80
_FAILURES = {0x100: "end stop", 0x200: "range limit", 0x400: "following error", 0x800: "the move failed"}


class SmarActStage:
    """Channels of one MCS2, in the order of `joints`; speeds in um/s or rad/s and `revolute`, shape (n_axes,)."""

    def __init__(
        self, link: Link, joints: tuple[int, ...], axes: tuple[ControllerAxis, ...], speeds: Floats, revolute: Bools
    ) -> None:
        self.name, self.joints = link.device, joints
        self._link, self._axes, self._speeds = link, axes, speeds
        self._wire = np.where(revolute, _NDEG, _PM)
        # Channels whose targets stay are left alone.
        self._targets = np.full(len(axes), np.nan)

    def prepare(self) -> None:
        """Connect; channels stopped that move, calibrated and referenced, speed set, absolute moves chosen."""
        self._link.open()
        self.stop()
        self._link.ask(f":DEV:SNUM?{_END}")
        for _ in range(self._number(":SYST:ERR:COUN?")):
            self._link.ask(f":SYST:ERR?{_END}")  # An error from before this session is none of ours.
        for axis, speed, wire in zip(self._axes, self._speeds, self._wire, strict=True):
            state = self._number(f":CHAN{axis.channel}:STAT?")
            for bit, name in ((_CALIBRATED, "calibrated"), (_REFERENCED, "referenced")):
                if not state & bit:
                    raise self._link.error(f"channel {axis.channel} is not {name}: do that by hand, then start again")
            self._link.send(f":CHAN{axis.channel}:MMOD 0{_END}")
            self._link.send(f":CHAN{axis.channel}:VEL {round(speed / wire)}{_END}")
        self._require_no_error(":CHAN:VEL")

    def move(self, positions: Floats) -> None:
        """Start to move, channel by channel."""
        for axis, q, before, wire in zip(self._axes, positions, self._targets, self._wire, strict=True):
            if q != before:
                count = float(axis.reading_of(np.asarray(q))) * axis.per_unit / wire
                self._link.send(f":MOVE{axis.channel} {round(count)}{_END}")
        self._require_no_error(":MOVE")
        self._targets = positions.copy()

    def position(self) -> Floats:
        """Joint values in um and rad."""
        counts = zip(self._axes, self._wire, self._numbers("POS"), strict=True)
        return np.array([axis.joint_value(np.asarray(count * wire / axis.per_unit)) for axis, wire, count in counts])

    def settled(self) -> bool:
        """Whether all channels hold their targets in closed loop."""
        still = True
        for axis, state in zip(self._axes, self._numbers("STAT"), strict=True):
            for bit, name in _FAILURES.items():
                if state & bit:
                    raise self._link.error(f"channel {axis.channel}: {name}")
            if not state & _REFERENCED:
                raise self._link.error(f"channel {axis.channel} lost its reference: was the controller reset?")
            still = still and not state & _MOVING and bool(state & _CLOSED_LOOP)
        return still

    def stop(self) -> None:
        """Stop every channel."""
        self._targets[:] = np.nan
        self._link.shout("".join(f":STOP{axis.channel}{_END}" for axis in self._axes))

    def stopped(self) -> bool:
        """Whether no channel moves; over a new connection, in which the stop is said again."""
        self._link.open()
        self.stop()
        return not any(state & _MOVING for state in self._numbers("STAT"))

    def _numbers(self, what: str) -> list[int]:
        queries = [f":CHAN{axis.channel}:{what}?{_END}" for axis in self._axes]
        return [self._whole(answer) for answer in self._link.ask_each(queries)]

    def _number(self, query: str) -> int:
        return self._whole(self._link.ask(query + _END))

    def _whole(self, answer: str) -> int:
        if not answer.removeprefix("-").isdecimal():
            raise self._link.error(f"expected a whole number, found {answer!r:.60}")
        return int(answer)

    def _require_no_error(self, command: str) -> None:
        """Commands have no answer; what went wrong with them stands in a queue."""
        if self._number(":SYST:ERR:COUN?"):
            raise self._link.error(self._link.ask(f":SYST:ERR?{_END}"), command)
