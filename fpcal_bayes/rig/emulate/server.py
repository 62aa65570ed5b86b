"""Sockets of emulated devices: one thread, loopback only, faults on demand."""

import contextlib
import selectors
import socket
import threading
from dataclasses import dataclass, field
from typing import Protocol

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.rig.clock import Clock, Halt
from fpcal_bayes.rig.drivers.interface import Address

_LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Protocoled(Protocol):
    """A device as its wire shows it."""

    def answers(self, buffer: bytearray) -> list[bytes]:
        """Carry out and remove all whole requests at the buffer's beginning; their answers, one each or none."""

    def fault(self, kind: str, active: bool) -> None:
        """A fault of the device itself begins or ends."""


@dataclass
class Endpoint:
    """One device on its port."""

    name: str
    device: Protocoled
    listener: socket.socket
    silent: bool = False  # requests are carried out, no answer comes
    half: bool = False  # the next answer stops half way, and no other comes on that connection
    down: bool = False  # the device is off: every connection is closed
    faulty: dict[str, float] = field(default_factory=dict)

    @property
    def address(self) -> Address:
        """Where it listens."""
        host, port = self.listener.getsockname()[:2]
        return Address(host, port)


class Server:
    """Serves the devices of one cell."""

    def __init__(self, clock: Clock) -> None:
        self.endpoints: dict[str, Endpoint] = {}
        self.clock = clock
        self._selector = selectors.DefaultSelector()
        self._halt = Halt()
        self._selector.register(self._halt, selectors.EVENT_READ, None)
        self._thread: threading.Thread | None = None
        self._connections: dict[socket.socket, tuple[Endpoint, bytearray]] = {}
        self._mute: set[socket.socket] = set()

    def add(self, name: str, device: Protocoled, address: Address) -> Endpoint:
        """Listen for a device on loopback; port 0 takes a free one, and so does the address of a real device."""
        if address.host not in _LOOPBACK:
            address = Address("127.0.0.1", 0)
        listener = socket.socket(socket.AF_INET6 if ":" in address.host else socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((address.host, address.port))
        except OSError as error:
            listener.close()
            raise InputError(f"{name} at {address}: cannot listen ({error.strerror}), expected a free port") from error
        listener.listen()
        listener.setblocking(False)
        endpoint = Endpoint(name, device, listener)
        self.endpoints[name] = endpoint
        self._selector.register(listener, selectors.EVENT_READ, endpoint)
        return endpoint

    def inject(self, name: str, kind: str, duration_s: float) -> None:
        """Begin a fault of a device; it ends after some seconds of the cell."""
        endpoint = self.endpoints[name]
        self._set(endpoint, kind, True)
        endpoint.faulty[kind] = self.clock.now() + duration_s

    def mend(self, name: str) -> None:
        """End all faults of a device, as whoever looks after the cell would."""
        endpoint = self.endpoints[name]
        for kind in list(endpoint.faulty):
            self._set(endpoint, kind, False)
        endpoint.faulty.clear()

    def start(self) -> None:
        """Serve in a thread."""
        self._thread = threading.Thread(target=self.run, name="emulated cell", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End serving, and close all sockets."""
        self._halt.request("stop")
        if self._thread is not None:
            self._thread.join()

    def run(self) -> None:
        """Serve until `stop`."""
        try:
            while not self._halt.reason:
                ends = [end for endpoint in self.endpoints.values() for end in endpoint.faulty.values()]
                patience = max(0.0, self.clock.wall(min(ends) - self.clock.now())) if ends else 0.05
                for key, _ in self._selector.select(patience):
                    if isinstance(key.data, Endpoint):
                        self._accept(key.data)
                    elif isinstance(key.fileobj, socket.socket):
                        self._serve(key.fileobj)
                self._end_faults()
        finally:
            self._close()

    def _accept(self, endpoint: Endpoint) -> None:
        with contextlib.suppress(OSError):
            connection, _ = endpoint.listener.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connections[connection] = (endpoint, bytearray())
            self._selector.register(connection, selectors.EVENT_READ, connection)
            if endpoint.down:
                self._drop(connection)

    def _serve(self, connection: socket.socket) -> None:
        if connection not in self._connections:
            return
        endpoint, buffer = self._connections[connection]
        try:
            data = connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data or endpoint.down:
            self._drop(connection)
            return
        buffer += data
        for answer in endpoint.device.answers(buffer):
            self._answer(connection, endpoint, answer)
        if len(buffer) > 1 << 20:
            self._drop(connection)

    def _answer(self, connection: socket.socket, endpoint: Endpoint, answer: bytes) -> None:
        if endpoint.silent or connection in self._mute:
            return
        if endpoint.half:
            answer, endpoint.half = answer[: max(1, len(answer) // 2)], False
            self._mute.add(connection)
        # Answers are short: what does not fit into the socket's buffer belongs to a client that does not read.
        with contextlib.suppress(OSError):
            connection.send(answer)

    def _set(self, endpoint: Endpoint, kind: str, active: bool) -> None:
        if kind == "no-answer":
            endpoint.silent = active
        elif kind == "half-line":
            endpoint.half = active
        else:
            endpoint.device.fault(kind, active)
            endpoint.down = active if kind == "reset" else endpoint.down
            for connection, (of, _) in list(self._connections.items()):
                # The connections of devices that are down are dropped soon.
                if of.down:
                    with contextlib.suppress(OSError):
                        connection.shutdown(socket.SHUT_RDWR)

    def _end_faults(self) -> None:
        now = self.clock.now()
        for endpoint in self.endpoints.values():
            for kind, end in list(endpoint.faulty.items()):
                if now >= end:
                    self._set(endpoint, kind, False)
                    endpoint.faulty.pop(kind, None)

    def _drop(self, connection: socket.socket) -> None:
        self._connections.pop(connection, None)
        self._mute.discard(connection)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(connection)
        connection.close()

    def _close(self) -> None:
        for connection in list(self._connections):
            self._drop(connection)
        for endpoint in self.endpoints.values():
            endpoint.listener.close()
        self._selector.close()
        self._halt.close()
