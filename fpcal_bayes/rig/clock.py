"""Time and interruption: a clock that may run faster than the wall's, and waits that end at once when all must stop."""

import contextlib
import select
import signal
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType

#: Signals that end a session: its axes are stopped and what was measured is kept.
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))


@dataclass(frozen=True)
class Clock:
    """Clock time of a cell."""

    speedup: float = 1.0  # seconds of the cell in a second of the wall; 1 for every cell that is real
    # Unix time at which both clocks show the same; an emulated cell and who drives it have the same one
    anchor: float = 0.0

    def now(self) -> float:
        """The cell's Unix time in s."""
        wall = time.time()
        return wall if self.speedup == 1.0 else self.anchor + (wall - self.anchor) * self.speedup

    def ticks(self) -> float:
        """Seconds of the cell since some moment; they go on evenly where the clock is set."""
        return time.monotonic() * self.speedup

    def wall(self, seconds: float) -> float:
        """Seconds of the wall that `seconds` of the cell take."""
        return seconds / self.speedup


class Halted(Exception):
    """All must stop; the message is one line and says why."""


class Halt:
    """Whether all must stop. A wait on it ends at once, in whatever thread or signal handler it is asked for."""

    def __init__(self) -> None:
        self.reason = ""
        self._heard, self._said = socket.socketpair()
        self._said.setblocking(False)

    def request(self, reason: str) -> None:
        """Ask that all stops; the first reason counts."""
        self.reason = self.reason or reason
        with contextlib.suppress(OSError):
            self._said.send(b"!")

    def fileno(self) -> int:
        """For `select`: readable from the moment all must stop."""
        return self._heard.fileno()

    def check(self) -> None:
        """Raise `Halted` if all must stop."""
        if self.reason:
            raise Halted(self.reason)

    def wait(self, wall_s: float) -> None:
        """Wait; raise `Halted` as soon as all must stop."""
        self.check()
        select.select([self], [], [], min(max(wall_s, 0.0), 1e6))
        self.check()

    def close(self) -> None:
        """Give the sockets back."""
        self._heard.close()
        self._said.close()

    @contextlib.contextmanager
    def on_signals(self) -> Iterator[None]:
        """While this lasts, Ctrl-C and requests to end ask that all stops; no exchange with a device is cut by them."""

        def hear(number: int, frame: FrameType | None) -> None:
            self.request(f"interrupted by {signal.Signals(number).name}")

        before = {number: signal.signal(number, hear) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
