"""Which rows share errors, in which order, when and from which side they were driven."""

from dataclasses import dataclass, fields, replace

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.sweeps import Sweeps, Texts
from fpcal_bayes.model.mechanics import Drive, drive_of


@dataclass(frozen=True)
class Sharing:
    """Of each row, the first row that has the same error; positions, shape (n,)."""

    reading: Ints  # the reading of its beam at its start: rows of one group and one beam
    start: Ints  # the pose at its start: rows of one group, and those read at the same moments by other beams
    end: Ints  # the pose at its end: rows of one shot that several beams read

    @classmethod
    def of(cls, sweeps: Sweeps) -> "Sharing":
        """Of rows in file order. Without several beams a shot says nothing."""
        several = bool((sweeps.beam != sweeps.beam[:1]).any())
        reading = _first(sweeps, sweeps.group, *([sweeps.beam] if several else []))
        if not several:
            return cls(reading, reading, np.arange(len(sweeps)))
        start, end = _first(sweeps, sweeps.group), _first(sweeps, sweeps.shot)
        while (start != (lower := np.minimum(_lowest(end, start), _lowest(start, start)))).any():
            start = lower
        return cls(reading, start, end)

    @property
    def several(self) -> bool:
        """Whether rows of several beams share the poses that were reached."""
        return bool((self.end != np.arange(len(self.end))).any() or (self.start != self.reading).any())

    @property
    def blocks(self) -> list[Ints]:
        """Positions of the rows of each sweep, as far as it has more than one."""
        return _blocks(self.start)

    @property
    def read_alike(self) -> list[Ints]:
        """Positions of the rows that share the reading at their start, where there are several."""
        return _blocks(self.reading)

    def columns(self, reading: Floats, starts: Floats, ends: Floats) -> Floats:
        """Shared effects of the reading (n,) and of joints at either end (n, n_joints), shape (n, n_shared)."""
        if not self.several:
            return np.column_stack([reading, starts])
        spread = [reading[:, None], ends]
        for k, first in enumerate((self.reading, self.end)):
            rank = np.zeros(len(first), dtype=np.int64)
            for rows in self.blocks:
                rank[rows] = np.unique(first[rows], return_inverse=True)[1]
            chosen = rank[:, None] == np.arange(rank.max(initial=0) + 1)
            spread[k] = (chosen[:, :, None] * spread[k][:, None, :]).reshape(len(first), -1)
        return np.hstack([spread[0], starts, spread[1]])


def _first(sweeps: Sweeps, name: Texts, *more: Texts) -> Ints:
    """The first row of the same session, name and more; a row whose name is empty is its own first."""
    result, named = np.arange(len(sweeps)), np.flatnonzero(name != "")
    keys = zip(*(column[named].tolist() for column in (sweeps.session, name, *more)), strict=True)
    first: dict[object, int] = {}
    result[named] = [first.setdefault(key, i) for key, i in zip(keys, named.tolist(), strict=True)]
    return result


def _lowest(of: Ints, values: Ints) -> Ints:
    """The least value among the rows that have the same entry in `of`, shape (n,)."""
    least = np.full(len(of), len(of))
    np.minimum.at(least, of, values)
    return least[of]


def _blocks(first: Ints) -> list[Ints]:
    members: dict[int, list[int]] = {}
    for i, place in enumerate(first.tolist()):
        members.setdefault(place, []).append(i)
    return [np.array(rows) for rows in members.values() if len(rows) > 1]


def drive_of_sweeps(sweeps: Sweeps, minutes_per_sweep: float, still: Floats | float = 0.0) -> Drive:
    """Order, times and approach of rows by session; a joint that moves up to `still`, um or rad (n_joints,), stands."""
    chosen = [sweeps.session == name for name in sweeps.sessions]
    parts = [_of_session(sweeps.take(mine), minutes_per_sweep, still) for mine in chosen]
    if len(parts) == 1:
        return parts[0]
    begun = np.cumsum([0, *(int(part.sweep.max()) + 1 for part in parts[:-1])])
    parts = [
        replace(part, sweep=part.sweep + first, session=part.session + i)
        for i, (part, first) in enumerate(zip(parts, begun.tolist(), strict=True))
    ]
    back = np.argsort(np.concatenate([np.flatnonzero(mine) for mine in chosen]))
    return Drive(*(np.concatenate([getattr(part, f.name) for part in parts])[back] for f in fields(Drive)))


def _of_session(sweeps: Sweeps, minutes_per_sweep: float, still: Floats | float) -> Drive:
    end = Sharing.of(sweeps).end
    moments, place = np.unique(end, return_inverse=True)
    if len(moments) < len(end):
        # What several beams read at one moment is one motion.
        driven = _of_session(sweeps.take(moments), minutes_per_sweep, still).take(place)
        driven = replace(driven, absolute=sweeps.absolute)
    else:
        driven = drive_of(
            sweeps.q_start,
            sweeps.q_end,
            absolute=sweeps.absolute,
            sweep=sweep_numbers(sweeps),
            time_h=sweeps.time_h,
            minutes_per_sweep=minutes_per_sweep,
            t_start_h=sweeps.t_start_h,
            t_end_h=sweeps.t_end_h,
            approach=sweeps.approach_signs(),
            still=still,
        )
    return replace(driven, beam=sweeps.beam, scaled=sweeps.scaled)


def sweep_numbers(sweeps: Sweeps) -> Ints:
    """Number of each row's sweep: neighbouring rows of one group share it, every other row is its own, shape (n,)."""
    new = np.ones(len(sweeps), dtype=bool)
    new[1:] = (sweeps.group[1:] != sweeps.group[:-1]) | (sweeps.group[1:] == "")
    return np.asarray(np.cumsum(new).astype(np.int64) - 1)
