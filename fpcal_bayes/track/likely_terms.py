"""What a drift may hold beside its random walks, where the log can tell: steady rates, and the temperature's part.

A cell states sizes of random walks; whether the day and night of its room matters is mostly not known beforehand. With
the temperature logged a few sessions tell. Terms that turn out to be zero cost a few sweeps in the first day; terms
that are left out cost errors for as long as the cell is followed.
"""

from dataclasses import replace

import numpy as np

from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.drift_sizes import DriftSize
from fpcal_bayes.track.drift import DriftModel

#: A steady rate makes in a day what the random walk makes; a kelvin what it makes in six hours, in which a room may
#: well warm by one. Both are standard deviations of what is unknown, found by the filter.
_RATE_DAYS, _KELVIN_DAYS = 1.0, 0.25


def likely_drift(cell: Cell, sweeps: Sweeps) -> DriftModel:
    """The drift that a cell states, with `likely_terms` where the sweeps log a temperature.

    A cell that states a rate, a returning motion or a part of the temperature itself is taken at its word.

    Raises
    ------
    InputError
        If the cell states no drift at all.
    """
    stated = DriftModel.of(cell)
    walks_only = all(size == DriftSize(size.name, walk=size.walk) for size in stated.sizes)
    logged = bool(np.isfinite(sweeps.temperature_c).any())
    return likely_terms(stated) if logged and walks_only else stated


def likely_terms(drift: DriftModel) -> DriftModel:
    """The drift with a steady rate and a temperature's part of each drifting angle of mirror and fibre."""
    angles = {p.name for p in drift.parameters if p.kind == "extrinsic" and p.unit == "deg"}

    def change(size: DriftSize) -> DriftSize:
        if size.name not in angles or not size.walk:
            return size
        return replace(size, rate_sd=size.walk / np.sqrt(_RATE_DAYS), temperature_sd=size.walk * np.sqrt(_KELVIN_DAYS))

    return drift.resized(change)
