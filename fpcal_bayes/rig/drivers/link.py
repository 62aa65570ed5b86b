"""A connection to a device: every wait has an end, every failure names device, address and command."""

import contextlib
import select
import socket
import time
from collections.abc import Callable, Sequence

from fpcal_bayes.rig.clock import Halt
from fpcal_bayes.rig.drivers.interface import Address, CommandLog, DeviceError, shown

#: An answer longer than this is none.
_MOST_BYTES = 1 << 20


class Link:
    """One TCP connection; after any failure it is closed, so that a late answer is never taken for another one's."""

    def __init__(self, device: str, address: Address, timeout_s: float, halt: Halt, log: CommandLog) -> None:
        self.device = device
        self.address = address
        self.timeout_s = timeout_s
        # Whether a wait for an answer ends when all must stop; not while the stopping itself talks to the device.
        self.obeys = True
        self._halt = halt
        self._log = log
        self._socket: socket.socket | None = None
        self._buffer = bytearray()
        self._asked = "connect"

    def open(self) -> None:
        """Connect anew; what an earlier connection still had to say is forgotten."""
        self.close()
        self._asked = "connect"
        try:
            made = socket.create_connection((self.address.host, self.address.port), self.timeout_s)
        except OSError as error:
            raise self.error(f"cannot connect ({_reason(error, self.timeout_s)})") from error
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setblocking(False)
        self._socket = made
        self._log.write(self.device, "-", f"connected to {self.address}")

    def close(self) -> None:
        """Close the connection, if there is one."""
        self._buffer.clear()
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def error(self, what: str, command: str | None = None) -> DeviceError:
        """The failure of a command, by default of the one sent last; the connection is given up."""
        self.close()
        found = DeviceError(self.device, self.address, self._asked if command is None else command, what)
        self._log.write(self.device, "-", str(found))
        return found

    def send(self, message: str) -> None:
        """Send a message as it stands."""
        self._asked = message
        self._log.write(self.device, ">", message)
        if self._socket is None:
            raise self.error("not connected")
        if self.obeys:
            self._halt.check()
        data, end = message.encode("latin-1"), time.monotonic() + self.timeout_s
        try:
            while data:
                _, ready, _ = select.select([], [self._socket], [], max(0.0, end - time.monotonic()))
                if not ready:
                    raise self.error(f"takes no more text within {self.timeout_s:g} s")
                data = data[self._socket.send(data) :]
        except OSError as error:
            raise self.error(f"the connection is lost ({_reason(error, self.timeout_s)})") from error

    def shout(self, message: str) -> None:
        """Send a message without any wait, if the connection is in a state to take it."""
        self._log.write(self.device, ">", message)
        with contextlib.suppress(OSError):
            if self._socket is not None:
                self._socket.send(message.encode("latin-1"))

    def take(self, length_of: Callable[[bytes], int]) -> str:
        """Wait for the answer sent last; `length_of` the bytes so far tells its length, or 0 while it is incomplete."""
        end = time.monotonic() + self.timeout_s
        while (length := length_of(bytes(self._buffer))) == 0:
            self._more(end)
        text = self._buffer[:length].decode("latin-1")
        del self._buffer[:length]
        self._log.write(self.device, "<", text)
        return text

    def ask(self, message: str, end: bytes = b"\r\n") -> str:
        """Send a message and wait for its answer of one line, which comes without the line's end."""
        return self.ask_each([message], end)[0]

    def ask_each(self, messages: Sequence[str], end: bytes = b"\r\n") -> list[str]:
        """Send messages at once and wait for their answers, of one line each."""
        if self._buffer:
            raise self.error(f"spoke unasked: {shown(self._buffer.decode('latin-1'))!r}", messages[0])
        self.send("".join(messages))
        answers = []
        for self._asked in messages:
            answers.append(self.take(lambda data: data.find(end) + len(end) if end in data else 0)[: -len(end)])
        return answers

    def _more(self, end: float) -> None:
        if self._socket is None:
            raise self.error("not connected")
        if len(self._buffer) > _MOST_BYTES:
            raise self.error("the answer has no end")
        watched = [self._socket.fileno(), *([self._halt.fileno()] if self.obeys else [])]
        ready, _, _ = select.select(watched, [], [], max(0.0, end - time.monotonic()))
        if self.obeys:
            self._halt.check()
        if not ready:
            part = f"half an answer, {shown(self._buffer.decode('latin-1'))!r}," if self._buffer else "no answer"
            raise self.error(f"{part} within {self.timeout_s:g} s")
        try:
            data = self._socket.recv(65536)
        except OSError as error:
            raise self.error(f"the connection is lost ({_reason(error, self.timeout_s)})") from error
        if not data:
            raise self.error("the device closed the connection")
        self._buffer += data


def _reason(error: OSError, timeout_s: float) -> str:
    return f"no answer within {timeout_s:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
