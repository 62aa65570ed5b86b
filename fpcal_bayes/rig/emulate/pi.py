"""A PI controller that speaks GCS 2.0."""

from collections.abc import Callable

import numpy as np

from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.rig.emulate.cell import EmulatedController, SimulatedCell, next_line

_UNKNOWN_COMMAND, _WRONG_PARAMETERS, _LIMITS, _STOPPED, _SERVO_OFF = 2, 1, 7, 10, 5
#: Faults in which the servo goes off, and the error that stands then.
_LOST = {"reset": 0, "following-error": -1024}

_SINGLE = {0x18: "STP", 0x05: "#5", 0x07: "#7"}
_COMMANDS = "*IDN?, ERR?, HLP?, MOV, MOV?, ONT?, POS?, SAI?, STP, SVO, SVO?, TMN?, TMX?, VEL, VEL?, #5, #7, #24"


class PIController(EmulatedController):
    """Axes of the cell behind GCS 2.0."""

    def __init__(self, lab: SimulatedCell, axes: dict[int, ControllerAxis]) -> None:
        super().__init__(lab, axes)
        self._servo = dict.fromkeys(self._joints, True)
        self._error = 0

    def answers(self, buffer: bytearray) -> list[bytes]:
        """One answer for each query among the requests."""
        found = []
        while buffer:
            if buffer[0] in _SINGLE:
                line = self._single(_SINGLE[buffer.pop(0)])
            elif (text := next_line(buffer)) is not None:
                line = self._command(text) if text else None
            else:
                break
            if line is not None:
                found.append((line + "\n").encode("latin-1"))
        return found

    def _suffer(self, channel: str, kind: str, active: bool) -> None:
        if not active:
            self._servo[channel] = kind != "reset"
        elif kind in _LOST:
            self._servo[channel], self._error = False, _LOST[kind]

    def _single(self, name: str) -> str | None:
        if name == "STP":
            self._stop()
            return None
        if name == "#5":
            now = self._lab.clock.now()
            moving = [self._lab.axes[joint].moving(now) for joint in self._joints.values()]
            return f"{sum(1 << bit for bit, on in enumerate(moving) if on):x}"
        return "\xb1"

    def _stop(self) -> None:
        self.stops.append(self._lab.clock.now())
        for joint in self._joints.values():
            self._lab.stop(joint)
        self._error = _STOPPED

    def _command(self, text: str) -> str | None:
        name, *words = text.split()
        name = name.upper()
        if name == "ERR?":
            error, self._error = self._error, 0
            return str(error)
        if name == "*IDN?":
            return "(c)2015 Physik Instrumente (PI) GmbH & Co. KG, E-712.3CD, 0, 0.1.0"
        if name == "HLP?":
            return " \n".join(["The following commands are available:", *_COMMANDS.split(", "), "end of help"])
        if name == "SAI?":
            return " \n".join(self._joints)
        if name == "STP":
            self._stop()
            return None
        queries: dict[str, Callable[[str], str]] = {
            "POS?": lambda c: f"{self._shown(c, self._lab.position(self._joints[c])):.6f}",
            "MOV?": lambda c: f"{self._shown(c, self._lab.axes[self._joints[c]].target):.6f}",
            "ONT?": lambda c: str(int(self._servo[c] and self._lab.settled(self._joints[c]))),
            "SVO?": lambda c: str(int(self._servo[c])),
            "VEL?": lambda c: f"{self._lab.axes[self._joints[c]].speed / self._axes[c].per_unit:.6f}",
            "TMN?": lambda c: f"{min(self._range(c)):.6f}",
            "TMX?": lambda c: f"{max(self._range(c)):.6f}",
        }  # fmt: skip
        if name in queries:
            channels = words or list(self._joints)
            if not set(channels) <= set(self._joints):
                self._error = _WRONG_PARAMETERS
                return None
            return " \n".join(f"{channel}={queries[name](channel)}" for channel in channels)
        if name in ("MOV", "SVO", "VEL"):
            self._error = self._set(name, words)
        else:
            self._error = _UNKNOWN_COMMAND
        return None

    def _set(self, name: str, words: list[str]) -> int:
        """Carry out a command for several axes, all of them or none; its error."""
        try:
            values = dict(zip(words[::2], map(float, words[1::2]), strict=True))
        except ValueError:
            return _WRONG_PARAMETERS
        if not values or not set(values) <= set(self._joints):
            return _WRONG_PARAMETERS
        if name == "SVO":
            self._servo.update({channel: value != 0.0 for channel, value in values.items()})
        elif name == "VEL":
            for channel, value in values.items():
                self._lab.axes[self._joints[channel]].speed = abs(value * self._axes[channel].per_unit)
        else:
            if not all(self._servo[channel] for channel in values):
                return _SERVO_OFF
            for channel, value in values.items():
                if not self._lab.move(self._joints[channel], float(self._axes[channel].joint_value(np.asarray(value)))):
                    return _LIMITS
        return 0

    def _shown(self, channel: str, q: float) -> float:
        return float(self._axes[channel].reading_of(np.asarray(q)))

    def _range(self, channel: str) -> tuple[float, float]:
        joint = self._lab.cell.joints[self._joints[channel]]
        return self._shown(channel, joint.low), self._shown(channel, joint.high)
