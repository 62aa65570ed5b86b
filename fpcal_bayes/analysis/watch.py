"""Looking after a file unattended: whatever it holds, the next look comes."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np

from fpcal_bayes.core.errors import reason

#: A file that did not change and could not be taken in is tried again after so many looks at most.
_MOST_LOOKS = 8


def watch(
    file: str | Path,
    seconds: float,
    take_in: Callable[[bool], None],
    say: Callable[[str], None],
    *,
    at_least: float = np.inf,
) -> NoReturn:
    """Take in a file, and again whenever it has changed or `at_least` seconds have passed, until interrupted.

    Nothing that the file holds ends this: one that is missing, held by another program or cannot be taken in is tried
    again later, even unchanged. `take_in` is told whether it came to its end the last time, `say` what is waited for.
    """
    seen: object = ()
    waiting, again = "", False
    looks, patience, due = 0, 1, 0.0
    while True:
        now, looks = stamp(file), looks + 1
        if now != seen or (waiting and looks >= patience) or time.monotonic() >= due:
            patience = 1 if now != seen else min(2 * patience, _MOST_LOOKS)
            seen, looks, due = now, 0, time.monotonic() + at_least
            try:
                take_in(again)
                waiting, again = "", True
            except Exception as error:
                before, waiting, again = waiting, reason(error), False
                if waiting != before:
                    say(f"{waiting}; looking again in {seconds:g} s")
        time.sleep(seconds)


def stamp(file: str | Path) -> tuple[int, ...] | None:
    """Tells one state of a file from another; None if it is not there."""
    try:
        found = os.stat(file)
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
