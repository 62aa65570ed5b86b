"""In which order, when and from which side the rows of a session were driven."""

import numpy as np

from fpcal_bayes.core.typing import Ints
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.mechanics import Drive, drive_of


def drive_of_sweeps(sweeps: Sweeps, minutes_per_sweep: float) -> Drive:
    """Order, times and directions of approach of one session's rows, as they stand in the file."""
    return drive_of(
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


def sweep_numbers(sweeps: Sweeps) -> Ints:
    """Number of each row's sweep: neighbouring rows of one group share it, every other row is its own, shape (n,)."""
    new = np.ones(len(sweeps), dtype=bool)
    new[1:] = (sweeps.group[1:] != sweeps.group[:-1]) | (sweeps.group[1:] == "")
    numbers: Ints = np.cumsum(new).astype(np.int64) - 1
    return numbers
