"""In which order, when and from which side the rows of a session were driven."""

from dataclasses import fields, replace

import numpy as np

from fpcal_bayes.core.typing import Ints
from fpcal_bayes.measure.sharing import Sharing
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.mechanics import Drive, drive_of


def drive_of_sweeps(sweeps: Sweeps, minutes_per_sweep: float) -> Drive:
    """Order, times and directions of approach of the rows, as they stand in the file, session by session."""
    chosen = [sweeps.session == name for name in sweeps.sessions]
    parts = [_of_session(sweeps.take(mine), minutes_per_sweep) for mine in chosen]
    if len(parts) == 1:
        return parts[0]
    begun = np.cumsum([0, *(int(part.sweep.max()) + 1 for part in parts[:-1])])
    parts = [
        replace(part, sweep=part.sweep + first, session=part.session + i)
        for i, (part, first) in enumerate(zip(parts, begun.tolist(), strict=True))
    ]
    back = np.argsort(np.concatenate([np.flatnonzero(mine) for mine in chosen]))
    return Drive(*(np.concatenate([getattr(part, f.name) for part in parts])[back] for f in fields(Drive)))


def _of_session(sweeps: Sweeps, minutes_per_sweep: float) -> Drive:
    end = Sharing.of(sweeps).end
    moments, place = np.unique(end, return_inverse=True)
    if len(moments) < len(end):
        # What several beams read at one moment is one motion.
        driven = replace(_of_session(sweeps.take(moments), minutes_per_sweep).take(place), absolute=sweeps.absolute)
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
        )
    return replace(driven, beam=sweeps.beam, scaled=sweeps.scaled)


def sweep_numbers(sweeps: Sweeps) -> Ints:
    """Number of each row's sweep: neighbouring rows of one group share it, every other row is its own, shape (n,)."""
    new = np.ones(len(sweeps), dtype=bool)
    new[1:] = (sweeps.group[1:] != sweeps.group[:-1]) | (sweeps.group[1:] == "")
    numbers: Ints = np.cumsum(new).astype(np.int64) - 1
    return numbers
