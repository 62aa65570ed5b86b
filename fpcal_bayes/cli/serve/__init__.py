"""``fpcal serve``: the cell answers controllers over HTTP."""

import argparse
import contextlib
import ipaddress
import socket
from pathlib import Path

from fpcal_bayes.cli.common import console
from fpcal_bayes.cli.driven import costs_of, goal_of
from fpcal_bayes.core.errors import InputError, reason
from fpcal_bayes.core.files import read_text
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.rig.clock import Clock
from fpcal_bayes.rig.reader import read_rig

try:
    from fpcal_bayes.cli.serve.app import make_app
    from fpcal_bayes.cli.serve.guard import make_server
    from fpcal_bayes.cli.serve.state import Files, Served
except ImportError as error:
    raise InputError(f'fpcal serve needs FastAPI and uvicorn ({error}): pip install "fpcal-bayes[serve]"') from error

_LEAST_TOKEN = 16


def run(options: argparse.Namespace, cell: Cell) -> int:
    """Run the command."""
    goal = goal_of(options, cell)
    clock = Clock() if options.rig is None else read_rig(options.rig, cell).clock
    token = _token(options.token)
    with listening(options.host, options.port, token) as listener:
        warm_up_inverse(cell)
        files = Files(options.campaign, Path(options.estimate), options.ticket)
        served = Served(files, cell, goal, lambda sweeps: costs_of(options, sweeps), clock.now)
        host, port = listener.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        console(options).say(f"{options.estimate}: served at http://{shown}:{port}")
        with contextlib.suppress(KeyboardInterrupt, SystemExit):
            make_server(make_app(served), token).run(sockets=[listener])
    return 0


def _token(file: str | None) -> str | None:
    if file is None:
        return None
    text = read_text(Path(file)).strip()
    if not (len(text) >= _LEAST_TOKEN and text.isascii() and text.isprintable() and " " not in text):
        raise InputError(f"{file}: expected a text of {_LEAST_TOKEN} or more ASCII characters without blanks")
    return text


def listening(host: str, port: int, token: str | None) -> socket.socket:
    """A socket that listens; without a token on loopback only."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        if token is None and not ipaddress.ip_address(address[0]).is_loopback:
            raise InputError(f"--host {host}: others could drive the cell: expected --token FILE too")
        listener = socket.create_server((str(address[0]), port), family=family, backlog=256)
        # Connections inherit it; without it an answer waits 40 ms for its second part.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listener
    except (OSError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"--host {host} --port {port}: cannot be listened on ({reason(error)})") from error
