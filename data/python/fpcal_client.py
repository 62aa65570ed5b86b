"""Ask ``fpcal serve`` from Python, by the standard library alone: copy this file beside your program."""

import http.client
import json
import os
import urllib.parse


class FpcalError(Exception):
    """A refusal; `kind` is refused, request, state, held, busy, token or internal.

    `despite` is what `joints` takes to have joints from an estimate that is not to be used.
    """

    def __init__(self, kind, message, despite=""):
        super().__init__(message)
        self.kind, self.despite = kind, despite


class Client:
    """One connection to a server; not to be shared by threads.

    `token` is by default that of the environment variable FPCAL_TOKEN.
    """

    def __init__(self, url="http://127.0.0.1:8765", token=None, timeout_s=120.0):
        found = urllib.parse.urlsplit(url)
        kind = http.client.HTTPSConnection if found.scheme == "https" else http.client.HTTPConnection
        self._connection = kind(found.hostname, found.port, timeout=timeout_s)
        self._token = os.environ.get("FPCAL_TOKEN") if token is None else token
        self._estimates = {}

    def estimate(self, flat=False):
        """The current best estimate as a file holds it, or with flat names; read again only when it has changed."""
        path = "/estimate?flat=true" if flat else "/estimate"
        etag, known = self._estimates.get(path, ("", None))
        status, headers, body = self._ask("GET", path, headers={"If-None-Match": etag} if etag else {})
        if status != 304:
            known = json.loads(body)
            self._estimates[path] = headers["ETag"], known
        return known

    def joints(self, poses=None, **others):
        """Joint values for poses, each six numbers or fX as 4 x 4, or of a task.

        `others`: task, radius_um, points, q_now, compensate, despite. Gives q, status and predicted_sd_nm per point.
        """
        request = others if poses is None else {"poses": poses, **others}
        return self._json("POST", "/joints", json.dumps(request), "application/json")

    def decision(self):
        """Whether to measure now, and what."""
        return self._json("GET", "/decision")

    def suggest(self, n=4):
        """The next sweeps that tell most."""
        return self._json("GET", f"/suggest?n={n}")["sweeps"]

    def sweeps(self, text):
        """Add a measured session, the text of a CSV of sweeps."""
        return self._json("POST", "/sweeps", text, "text/csv")

    def health(self):
        """Whether there is an estimate to be driven with."""
        return self._json("GET", "/health")

    def close(self):
        """Close the connection; the next question opens another."""
        self._connection.close()

    def _json(self, *request):
        return json.loads(self._ask(*request)[2])

    def _ask(self, method, path, body=None, kind=None, headers=None):
        sent = dict(headers or {})
        if kind is not None:
            sent["Content-Type"] = kind
        if self._token:
            sent["Authorization"] = f"Bearer {self._token}"
        data = None if body is None else body.encode()
        for last in (False, True):
            fresh = self._connection.sock is None
            try:
                self._connection.request(method, path, data, sent)
                answer = self._connection.getresponse()
                break
            except (ConnectionError, http.client.BadStatusLine):
                # A connection that stood idle is closed by the server; what it had not begun to answer is sent again.
                self._connection.close()
                if fresh or last:
                    raise
        text = answer.read()
        if answer.status >= 400:
            error = json.loads(text)["error"]
            raise FpcalError(error["kind"], error["message"], error.get("despite") or "")
        return answer.status, answer.headers, text
