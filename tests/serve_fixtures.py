"""A server in a thread of the test, on a free port of loopback."""

import json
import threading
import time
from contextlib import contextmanager
from datetime import UTC, datetime
from http.client import HTTPConnection
from pathlib import Path

from fpcal_bayes.cli.serve import Files, Served, listening, make_app, make_server
from fpcal_bayes.core.files import write_json
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.model.estimate import SCHEMA

CLIENTS = Path(str(data_file("python/fpcal_client.py"))).parent


def write_estimate(path, estimate, **more):
    """As `fpcal keep` writes it; of now, for a day, unless the estimate says otherwise."""
    said = estimate.content()
    said["data"] = said["data"] or {"utc": datetime.now(UTC).isoformat(), "session": "s1"}
    write_json(Path(path), {"schema": SCHEMA, "command": "track", **said, **more})


@contextmanager
def serving(cell, campaign, estimate, *, ticket=None, token=None, goal=None, now=time.time):
    """Its address."""
    served = Served(
        Files(Path(campaign), Path(estimate), ticket), cell, goal or Goal(50.0), lambda _: Costs(sigma_nm=5.0), now
    )
    with listening("127.0.0.1", 0, token) as listener:
        server = make_server(make_app(served), token)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        end = time.monotonic() + 20.0
        while not server.started and time.monotonic() < end:
            time.sleep(0.01)
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(20.0)


def ask(url, method, path, body=None, **headers):
    """Status, headers and what stands in the body, of one request."""
    connection = HTTPConnection(url.removeprefix("http://"), timeout=60)
    if isinstance(body, dict):
        body, headers = json.dumps(body), {"Content-Type": "application/json"} | headers
    connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    found = json.loads(text) if "json" in answer.headers.get("Content-Type", "") and text else text.decode()
    return answer.status, answer.headers, found
