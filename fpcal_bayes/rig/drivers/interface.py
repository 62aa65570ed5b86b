"""What every device can do, and how its failures read."""

import contextlib
import math
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.times import iso
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.rig.clock import Clock

#: What a log line holds of one message.
_LOGGED = 400
#: How often looks that are alike are written, in s of the wall.
_ALIKE_S = 1.0
#: A line that asks and changes nothing: a query (but the one that takes from SCPI's queue), or a getter of JSON-RPC.
_LOOK = re.compile(r'(?!:SYST:ERR\?)[^\s?]+\?(\s|$)|\{.*"method": "[\w.]+\.get[A-Z]')


class DeviceError(InputError):
    """A device failed; the message is one line: device, address, command, what happened."""

    def __init__(self, device: str, address: object, command: str, what: str) -> None:
        super().__init__(f"{device} at {address}: {shown(command)}: {what}")
        self.device = device


class Disturbed(Exception):
    """A reading or a sweep that gives no reliable number; the devices are well."""


@dataclass(frozen=True)
class Address:
    """Host and port of a device."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class Stage(Protocol):
    """A motion controller with some of the cell's joints."""

    name: str
    #: Which places of the joint vector its axes hold, in the order of all arrays below.
    joints: tuple[int, ...]

    def prepare(self) -> None:
        """Connect, stop axes that move; hold them to what a safe move needs (servo, reference, speed)."""

    def move(self, positions: Floats) -> None:
        """Start to move to joint values in um and rad, shape (n_axes,); does not wait."""

    def position(self) -> Floats:
        """Joint values read back, in um and rad, shape (n_axes,)."""

    def settled(self) -> bool:
        """Whether the controller says that all axes stand on their targets; `DeviceError` if they never will."""

    def stop(self) -> None:
        """Tell all axes to stop, at once, without waiting for an answer and whatever was asked before."""

    def stopped(self) -> bool:
        """Whether all axes stand still, asked over a connection of its own after `stop`."""


class Interferometer(Protocol):
    """An instrument that knows the cavity length at rest, up to a constant."""

    name: str

    def prepare(self) -> None:
        """Connect; hold the instrument to what a reading needs."""

    def length(self) -> float:
        """Cavity length in um, up to a constant; `Disturbed` if it is not steady or not seen."""

    def watch(self) -> None:
        """Raise `Disturbed` if the fringes are lost now."""

    def temperature_c(self) -> float:
        """Temperature of the air, or NaN."""


class CommandLog:
    """A log of the messages to and from the devices, a line each, in the cell's time.

    Looks ask and change nothing. Of those alike but for a request's number one a second is written with its answer, and
    the last before whatever is written next; each says how many were left out before it. All else is written at once.
    """

    def __init__(self, path: Path | None, clock: Clock) -> None:
        self._clock = clock
        self._file: IO[str] | None = None
        self._broken, self._path = "", path
        # Of looks since a command: when one was written (s of the wall) and how many were not since; the last of these.
        self._asked: dict[str, str] = {}
        self._seen: dict[str, tuple[float, int]] = {}
        self._held: dict[str, list[str]] = {}
        if path is not None:
            try:
                self._file = path.open("a", encoding="utf-8", buffering=1)
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({error.strerror})") from error

    def write(self, device: str, mark: str, text: str) -> None:
        """Add a line; `mark` is ``>`` for what is sent, ``<`` for what comes back, ``-`` for a remark."""
        line = f"{iso(self._clock.now())} {device} {mark} {shown(text, _LOGGED)}"
        if mark == ">":
            self._asked[device] = f"{device} {re.sub(r'"id": [0-9]+', '', text)}"
        asked = self._asked.get(device, "")
        if mark == "<" and asked in self._held:
            self._held[asked].append(line)
        elif mark == ">" and all(map(_LOOK.match, text.splitlines())):
            at, count = self._seen.get(asked, (-math.inf, 0))
            self._held.pop(asked, None)  # The file goes by time.
            self._held[asked] = [line + (f" ({count} alike before it)" if count else "")]
            self._seen[asked] = (at, count + 1)
            if time.monotonic() - at >= _ALIKE_S:
                self._put()
        else:
            self._put(line)
            if mark != "<":
                self._seen.clear()

    def _put(self, *lines: str) -> None:
        """Write the looks that are held, then lines."""
        held = [line for look in self._held.values() for line in look]
        self._seen.update(dict.fromkeys(self._held, (time.monotonic(), 0)))
        self._held.clear()
        try:
            if self._file is not None:
                self._file.writelines(f"{line}\n" for line in (*held, *lines))
        except OSError as error:
            self._broken = f"{self._path}: cannot be written ({error.strerror})"
            self.close()

    def check(self) -> None:
        """Raise `InputError` if a line could not be written; `write` itself never does, so that all can be stopped."""
        if self._broken:
            raise InputError(self._broken)

    def close(self) -> None:
        """Write what is left and close the file."""
        self._put()
        with contextlib.suppress(OSError):
            if self._file is not None:
                self._file.close()
        self._file = None


def shown(text: str, most: int = 80) -> str:
    """A message as a line of text: control characters escaped, cut if it is long."""
    line = text.rstrip("\r\n").encode("unicode_escape").decode("ascii")
    return line if len(line) <= most else line[:most] + "..."
