"""A SmarAct MCS2 that speaks its ASCII protocol."""

import math
import re

import numpy as np

from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.rig.emulate.cell import EmulatedController, SimulatedCell, next_line

_MOVING, _CLOSED_LOOP, _SENSOR, _CALIBRATED, _REFERENCED = 0x1, 0x2, 0x20, 0x40, 0x80
_FAULTS = {"end-stop": 0x100, "following-error": 0x400 | 0x800}

_QUERY = re.compile(r":CHAN(?:nel)?(\d+):(POS|VEL|MMOD|STAT|ACC)(?:\w*)\?", re.IGNORECASE)
_SET = re.compile(r":CHAN(?:nel)?(\d+):(VEL|MMOD|ACC) (-?\d+)", re.IGNORECASE)
_MOVE = re.compile(r":MOVE(\d+) (-?\d+)", re.IGNORECASE)
_STOP = re.compile(r":STOP(\d+)", re.IGNORECASE)

_UNDEFINED = '-113,"Undefined header"'
_RANGE = '-222,"Data out of range"'
_NOT_REFERENCED = '-221,"Settings conflict;not referenced"'


class MCS2(EmulatedController):
    """Joints of the cell behind an MCS2; lengths in pm, angles in ndeg."""

    def __init__(self, lab: SimulatedCell, axes: dict[int, ControllerAxis]) -> None:
        super().__init__(lab, axes)
        self._wire = {axis.channel: math.radians(1e-9) if lab.cell.revolute[j] else 1e-6 for j, axis in axes.items()}
        self._mode = dict.fromkeys(self._joints, 0)
        self._referenced = dict.fromkeys(self._joints, True)
        self._failed = dict.fromkeys(self._joints, 0)
        self._errors: list[str] = []

    def answers(self, buffer: bytearray) -> list[bytes]:
        """One answer for each query among the requests; an unknown one has none."""
        found = []
        while (text := next_line(buffer)) is not None:
            line = self._command(text) if text else None
            if line is not None:
                found.append((line + "\r\n").encode("latin-1"))
        return found

    def _suffer(self, channel: str, kind: str, active: bool) -> None:
        if kind == "reset":
            # Whoever looks after the cell references the channels again before it is called mended.
            self._referenced[channel] = not active
        self._failed[channel] = _FAULTS.get(kind, 0) if active else 0

    def _command(self, text: str) -> str | None:
        upper = text.upper()
        known = {":SYST:ERR:COUN?": str(len(self._errors)), "*IDN?": "SmarAct,MCS2,MCS2-00001234,1.3.14"}
        known |= dict.fromkeys((":DEV:SNUM?", ":DEVICE:SNUMBER?"), "MCS2-00001234")
        if upper in known:
            return known[upper]
        if upper in (":SYST:ERR?", ":SYST:ERR:NEXT?"):
            return self._errors.pop(0) if self._errors else '0,"No error"'
        for pattern, act in ((_QUERY, self._query), (_SET, self._set), (_MOVE, self._move), (_STOP, self._stop)):
            match = pattern.fullmatch(text)
            if match and match[1] in self._joints:
                return act(*match.groups())
        self._errors.append(_UNDEFINED)
        return None

    def _query(self, channel: str, what: str) -> str:
        joint, axis = self._joints[channel], self._lab.axes[self._joints[channel]]
        what = what.upper()
        if what == "POS":
            stated = self._axes[channel]
            reading = float(stated.reading_of(np.asarray(self._lab.position(joint))))
            return str(round(reading * stated.per_unit / self._wire[channel]))
        if what == "VEL":
            return str(round(axis.speed / self._wire[channel]))
        if what == "STAT":
            now = self._lab.clock.now()
            state = _CLOSED_LOOP | _SENSOR | _CALIBRATED | self._failed[channel]
            state |= _REFERENCED if self._referenced[channel] else 0
            return str(state | (0 if axis.settled(now) or axis.stuck == axis.stuck else _MOVING))
        return str(self._mode[channel]) if what == "MMOD" else "0"

    def _set(self, channel: str, what: str, value: str) -> None:
        if what.upper() == "VEL":
            self._lab.axes[self._joints[channel]].speed = max(1, int(value)) * self._wire[channel]
        elif what.upper() == "MMOD":
            self._mode[channel] = int(value)

    def _move(self, channel: str, value: str) -> None:
        stated = self._axes[channel]
        reading = int(value) * self._wire[channel] / stated.per_unit
        if not self._referenced[channel] or self._mode[channel] != 0:
            self._errors.append(_NOT_REFERENCED)
        elif not self._lab.move(self._joints[channel], float(stated.joint_value(np.asarray(reading)))):
            self._errors.append(_RANGE)

    def _stop(self, channel: str) -> None:
        self.stops.append(self._lab.clock.now())
        self._lab.stop(self._joints[channel])
