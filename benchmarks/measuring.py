"""One measurement of time and memory against size."""

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: Repeats of a short call, and how long a call may take to be repeated, in s.
_REPEATS, _SHORT = 6, 0.3
#: Above this slope the cost does not count as linear: fixed costs per row shrink as batches fill the caches.
LINEAR = 1.1


@dataclass(frozen=True)
class Point:
    """One measurement.

    Attributes
    ----------
    what
        Is done.
    size
        Of it, counted in `of`.
    seconds
        Of the processor, the least of some calls.
    mebibytes
        Most that Python and NumPy had allocated at once.
    of
        What the size counts.
    peer
        Whether another program does it.
    """

    what: str
    size: int
    seconds: float
    mebibytes: float
    of: str = "rows"
    peer: bool = False


def timed(what: str, size: int, function: Callable[[], object], of: str = "rows", *, peer: bool = False) -> Point:
    """Least processor seconds of some calls, one if it takes long, and the memory of one more."""
    seconds, repeats = np.inf, 0
    while repeats == 0 or (repeats < _REPEATS and seconds < _SHORT):
        began = time.process_time()
        function()
        seconds, repeats = min(seconds, time.process_time() - began), repeats + 1
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    point = Point(what, size, float(seconds), peak / 2**20, of, peer)
    print(f"{what:44} {size:8} {of:14} {point.seconds:12.6f} s  {point.mebibytes:9.2f} MiB", flush=True)
    return point


def exponents(points: list[Point]) -> dict[str, float]:
    """Slope of log time against log size over the larger half of the sizes, three at least, for each thing timed."""
    found = {}
    for what in dict.fromkeys(point.what for point in points):
        chosen = sorted((p.size, max(p.seconds, 1e-9)) for p in points if p.what == what)
        upper = np.log(np.array(chosen[min(len(chosen) // 2, max(0, len(chosen) - 3)) :]))
        if len(upper) > 1:
            found[what] = float(np.polyfit(upper[:, 0], upper[:, 1], 1)[0])
    return found


def too_steep(points: list[Point]) -> dict[str, float]:
    """Exponents of our own costs that are more than linear in rows, sessions, poses or traces."""
    chosen = [p for p in points if not p.peer and p.of != "parameters"]
    return {what: slope for what, slope in exponents(chosen).items() if slope > LINEAR}
