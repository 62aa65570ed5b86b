"""A trace made ready: held to its sweep, looked through for faults, and laid along the sweep."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.kernels import sums_in_bins
from fpcal_bayes.fringes.profile import legendre
from fpcal_bayes.measure.traces import Trace

#: The joint readings at the ends of a trace may miss the sweep's ends by this share of the travel.
END_TOLERANCE = 0.02
#: Fewer samples tell neither fringes nor noise.
FEWEST = 8
#: A hole in the record: a step of the joint this many times the mean step, and in share of the travel.
_HOLE_STEPS, _HOLE_SHARE = 6.0, 0.02
#: Equal readings in a row at the top or the bottom of a signal that make it clipped.
_FLAT_RUN, _FLAT_SHARE = 3, 0.004
#: More of them than this many times the readings a few steps beside: clipped, and not a coarse converter.
_CROWDED = 2.0
#: A signal above this many times the full scale is not in volts.
_OTHER_UNIT = 1.5


@dataclass(frozen=True)
class Samples:
    """Irradiance along a sweep."""

    s: Floats  # place on the sweep: -1 where the index says that it starts, 1 where it ends, shape (n,)
    time: Floats  # from -1 at the first sample to 1 at the last, shape (n,)
    signal: Floats  # in V, shape (n,)
    count: Floats  # readings averaged in each, shape (n,)
    spread: Floats | float = 0.0  # variance of the places averaged in each, shape (n,)

    def __len__(self) -> int:
        return len(self.signal)

    def part(self, kept: NDArray[np.bool_] | slice) -> "Samples":
        """Those samples that are kept."""
        spread = self.spread if isinstance(self.spread, float) else self.spread[kept]
        return Samples(self.s[kept], self.time[kept], self.signal[kept], self.count[kept], spread)

    def levelled(self) -> Floats:
        """The signal without its mean, slope and bow along the sweep, (n,)."""
        low = legendre(self.s, 2)
        weighted = low.T * self.count
        return np.asarray(self.signal - low @ np.linalg.solve(weighted @ low, weighted @ self.signal))

    def binned(self, n_bins: int) -> "Samples":
        """Averages over bins of equal width in s, each at the mean place of its readings; empty bins are left out."""
        if len(self) <= 1.5 * n_bins:
            return self
        low, high = self.s.min(), self.s.max()
        place = np.minimum(((self.s - low) * (n_bins / (high - low))).astype(np.int64), n_bins - 1)
        return self.summed(lambda values: sums_in_bins(place, values, n_bins))

    def summed(self, into: Callable[[tuple[Floats, ...]], Iterable[Floats]]) -> "Samples":
        """Averages over the parts that `into` sums each of values (n,) over, (n_parts,); empty ones are left out."""
        parts = (self.s, self.time, self.signal, self.spread + self.s**2)
        count, *sums = into((self.count, *(self.count * part for part in parts)))
        filled = count > 0
        s, time, signal, square = (each[filled] / count[filled] for each in sums)
        return Samples(s, time, signal, count[filled], np.maximum(square - s**2, 0.0))


def lay_out(trace: Trace, start: float, end: float, *, unit: str, scale: float, place: str) -> Samples:
    """Lay a trace along its sweep from `start` to `end` of the joint that moves, in um or rad.

    unit, scale: of that joint as a person reads it, and internal units per shown unit. place: begins a message without
    file.
    """
    s = (2.0 * trace.joint - start - end) / (end - start)
    wanted = [f"{value / scale:.6g}" for value in (start, end)]
    beyond = np.abs(s) > 1.0 + 4.0 * END_TOLERANCE
    why, found = "", trace.joint[int(np.argmax(beyond))] / scale
    if beyond.any():
        why = f"{found:.6g} {unit} lies outside the sweep of the index, expected {wanted[0]} to {wanted[1]} {unit}"
    for at, name in ((-1, "end"), (0, "start")):
        if abs(s[at] - (-1.0, 1.0)[at]) > 2.0 * END_TOLERANCE:
            found = trace.joint[at] / scale
            why = f"the {name} at {found:.6g} {unit} disagrees with the index, expected {wanted[at]} {unit}"
    if why:
        raise located(trace.file or place, why, column="joint")
    first, last = trace.time_s[0], trace.time_s[-1]
    return Samples(s, (2.0 * trace.time_s - first - last) / (last - first), trace.irradiance, np.ones(len(s)))


def fault(samples: Samples, full_scale: float | None = None) -> str:
    """Why a trace cannot be read at all, as a phrase; empty if it can. full_scale: volts at the converter's end."""
    n = len(samples)
    if n < FEWEST:
        return f"{n} samples, expected {FEWEST} or more"
    signal = samples.signal
    if signal.max() == signal.min():
        return "the signal is constant"
    if clipped := _clipped(signal, full_scale):
        return clipped
    steps = np.abs(np.diff(samples.s))
    widest = int(np.argmax(steps))
    if n > 20 and steps[widest] > max(_HOLE_STEPS * 2.0 / n, 2.0 * _HOLE_SHARE):
        return f"a gap: no samples over {50 * steps[widest]:.1f} % of the sweep"
    return ""


def _clipped(signal: Floats, full_scale: float | None) -> str:
    top, bottom = float(signal.max()), float(signal.min())
    if full_scale is not None and top > _OTHER_UNIT * full_scale:
        unit = "counts of the converter" if (signal == np.rint(signal)).all() else "millivolts, 0.001 of it"
        return f"expected volts up to the full scale of {full_scale:g} V, found {bottom:g} to {top:g}: perhaps {unit}"
    if full_scale is not None and top >= full_scale * (1 - 1e-9):
        return f"saturated: the signal reaches the full scale of {full_scale:g} V{_remedy(signal, top)}"
    for extreme, name in ((top, "top"), (bottom, "bottom")):
        flat = signal == extreme
        edges = np.flatnonzero(np.diff(np.concatenate([[False], flat, [False]]).astype(np.int8)))
        run, share = int((edges[1::2] - edges[::2]).max(initial=0)), float(flat.mean())
        if run < _FLAT_RUN or share <= _FLAT_SHARE or flat.sum() <= _FLAT_RUN:
            continue
        # Steps of a coarse converter make flat tops too, but never crowd an extreme more than the steps beside it.
        away = np.abs(signal - extreme)
        near = (away <= max(4.0 * float(away[~flat].min()), 0.004 * (top - bottom))) & ~flat
        if flat.sum() > _CROWDED * near.sum():
            return f"saturated: {int(flat.sum())} samples stand at the {name}, {extreme:g} V{_remedy(signal, extreme)}"
    return ""


def _remedy(signal: Floats, extreme: float) -> str:
    """How much less gain a signal cut off at an extreme needs, by the share of a sine that is cut off."""
    cut = float((signal == extreme).mean() if extreme < signal.mean() else (signal >= extreme).mean())
    share = 0.45 * (1.0 + np.cos(np.pi * min(cut, 0.9)))
    return f"; lower the gain to {share:.2f} of it" if extreme > 0 else ""
