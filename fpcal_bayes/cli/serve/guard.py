"""What stands between the network and the endpoints: token, sizes, times, and one form of answers."""

import asyncio
import json
import re
import secrets
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qs

import uvicorn
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

#: Bytes of a request's body, of all that are held at a time, and of its head; connections at a time.
MOST_BYTES, _MOST_HELD, _MOST_HEAD, _MOST_CONNECTIONS = 2 << 20, 64 << 20, 16 << 10, 256
#: Seconds in which a request must have come, or an answer been taken away.
_SECONDS = 10.0
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


def answer(status: int, content: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    """JSON in ASCII, so that any text of a request may be repeated in it."""
    return Response(json.dumps(content, allow_nan=False), status, dict(headers or {}), media_type="application/json")


class Guard:
    """Lets whole requests pass that carry the token; without one those that a program on this machine made."""

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self._app, self._held = app, 0
        self._token = None if token is None else f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        headers = dict(scope["headers"])
        body = bytearray()
        try:
            refusal = self._refusal(headers)
            if refusal is None:
                refusal = await self._take(receive, headers, body)
            if refusal is not None:
                shown = 200 if b"always_200=1" in scope["query_string"] else refusal[0]
                error = {"error": dict(zip(("kind", "message"), refusal[1:], strict=True))}
                return await answer(shown, error, {"Connection": "close"})(scope, receive, send)
            text, kind = bytes(body), headers.get(b"content-type", b"")
            if kind.startswith(b"application/x-www-form-urlencoded"):
                # From clients that can send forms only.
                text = (parse_qs(text, max_num_fields=9).get(b"request") or [b""])[0]
                kind = b"application/json" if text.lstrip().startswith(b"{") else b"text/csv"
            parts = iter([{"type": "http.request", "body": text, "more_body": False}])

            async def again() -> Message:
                return next(parts, None) or await receive()

            described = [*(headers | {b"content-type": kind}).items()]
            await self._app({**scope, "headers": described}, again, send)
        finally:
            self._held -= len(body)

    def _refusal(self, headers: Mapping[bytes, bytes]) -> tuple[int, str, str] | None:
        if self._token is not None:
            if secrets.compare_digest(headers.get(b"authorization", b""), self._token):
                return None
            return 401, "token", "expected the header Authorization: Bearer TOKEN"
        # A page in a browser on this machine must not speak for its user.
        name = re.sub(rb":[0-9]*$", b"", headers.get(b"host", b"")).decode("latin-1")
        if name.lower() not in _LOOPBACK or b"origin" in headers:
            return 403, "request", "expected a program on this machine, which asks 127.0.0.1 and sends no Origin"
        return None

    async def _take(
        self, receive: Receive, headers: dict[bytes, bytes], body: bytearray
    ) -> tuple[int, str, str] | None:
        """Take the whole body in; JSON or CSV may come as the field `request` of a form."""
        try:
            async with asyncio.timeout(_SECONDS):
                more = True
                while more:
                    message = await receive()
                    part = message.get("body", b"")
                    body += part
                    self._held += len(part)
                    if len(body) > MOST_BYTES:
                        return 413, "request", f"expected at most {MOST_BYTES} bytes"
                    if self._held > _MOST_HELD:
                        return 429, "busy", "too many long requests at once: ask again in a few seconds"
                    more = message.get("more_body", False)
        except TimeoutError:
            return 408, "request", f"the request did not come to its end in {_SECONDS:g} s"
        return None


class _Patient(H11Protocol):
    """A connection that is closed where nothing comes, or nobody takes the answer away."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._left = -1
        if len(self.connections) > _MOST_CONNECTIONS:
            transport.abort()
        self._look()

    def send_400_response(self, msg: str) -> None:
        """Tell what is no HTTP so, in the form of every error."""
        super().send_400_response(json.dumps({"error": {"kind": "request", "message": msg}}))

    def _look(self) -> None:
        left = self.transport.get_write_buffer_size()
        waiting = self.cycle is None or self.cycle.response_complete
        asleep = self.timeout_keep_alive_task is not None
        if (waiting and not asleep and not left and self._left == 0) or (left and left == self._left):
            self.transport.abort()
        self._left = left if left or (waiting and not asleep) else -1
        if not self.transport.is_closing():
            self.loop.call_later(_SECONDS / 2, self._look)


def make_server(app: ASGIApp, token: str | None) -> uvicorn.Server:
    """The server of an application, with its limits."""
    config = uvicorn.Config(
        Guard(app, token),
        http=_Patient,
        ws="none",
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        h11_max_incomplete_event_size=_MOST_HEAD,
        timeout_keep_alive=60,
        timeout_graceful_shutdown=3,
    )
    return uvicorn.Server(config)
