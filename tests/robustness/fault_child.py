"""A command in a process of its own, which may be killed, and what its files say."""

import contextlib
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import arviz  # noqa: F401  (commands import it late, each child anew)
import h5py

from fpcal_bayes.cli.main import main as fpcal
from fpcal_bayes.core.files import file_sha256

#: No command of these studies takes so long, in s.
DEADLINE = 300.0
#: Exit status of a command that ended with a traceback.
TRACEBACK = 70


@dataclass(frozen=True)
class Outcome:
    """How a command ended; `code` is None if it was killed."""

    code: int | None
    errors: str

    @property
    def one_line(self) -> bool:
        """Whether it was refused by exactly one line."""
        return self.code == 2 and self.errors.startswith("fpcal: error: ") and len(self.errors.splitlines()) == 1


class Child:
    """A command in a process of its own."""

    def __init__(self, arguments: tuple[str, ...], folder: Path, prepare: Callable[[], None] = lambda: None) -> None:
        self._reading, writing = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            self._run(arguments, folder, prepare, writing)
        os.close(writing)

    @staticmethod
    def _run(arguments: tuple[str, ...], folder: Path, prepare: Callable[[], None], writing: int) -> None:
        code = TRACEBACK
        # What this program does about signals is not what the command does.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(writing, 2)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
            os.chdir(folder)
            prepare()
            code = fpcal([*arguments, "--quiet"])
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stderr.flush()
            os._exit(code)

    def wait(self, kill_after: float | None = None, by: int = signal.SIGKILL) -> Outcome:
        """The outcome; with `kill_after` the command is killed so many seconds from now, if it still runs."""
        began, killed = time.monotonic(), False
        limit = DEADLINE if kill_after is None else kill_after
        while os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            if time.monotonic() - began > limit and not killed:
                os.kill(self.pid, signal.SIGKILL if kill_after is None else by)
                killed = True
            time.sleep(0.002)
        with os.fdopen(self._reading, "rb") as pipe:
            errors = pipe.read().decode(errors="replace")
        _, status = os.waitpid(self.pid, 0)
        code = os.waitstatus_to_exitcode(status)
        if code < 0 and kill_after is None:
            return Outcome(TRACEBACK, f"ended by signal {-code}: {errors}")
        return Outcome(None if code < 0 or code == 128 + by else code, errors)


def contents(folder: Path) -> dict[str, str]:
    """Hash of every file in a folder, hidden ones left out."""
    return {
        str(path.relative_to(folder)): file_sha256(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def meaning(path: Path) -> Any:
    """What a file says, without times that no two runs share."""
    if path.suffix == ".json":

        def timeless(value: Any) -> Any:
            if isinstance(value, dict):
                timed = ("seconds", "content_sha256")
                return {key: timeless(entry) for key, entry in value.items() if key not in timed}
            return [timeless(entry) for entry in value] if isinstance(value, list) else value

        return timeless(json.loads(path.read_text()))
    if path.suffix == ".html":
        # Pages say when and how long.
        return path.read_bytes()[:15]
    if path.suffix == ".nc":
        with h5py.File(path) as file:
            return {name: file["posterior"][name][()].tobytes() for name in sorted(file["posterior"])}
    if path.suffix == ".mat":
        # The first bytes say when it was made.
        return path.read_bytes()[128:]
    return path.read_bytes()


def is_part(path: Path, whole: Any) -> bool:
    """Whether a store of replicates has some lines of the whole one, and at its end perhaps a part of another."""
    *lines, last = path.read_bytes().split(b"\n")
    known = whole.split(b"\n")
    return known[:1] == lines[:1] and set(lines) <= set(known) and any(line.startswith(last) for line in known)
