"""The true parameters of a simulated cell through time."""

import contextlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import paper_tables
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet


@dataclass(frozen=True)
class TruthRecord:
    """A truth as files hold it, in the units a person reads."""

    #: names, units: Of the parameters, n of each.
    names: tuple[str, ...]
    units: tuple[str, ...]
    times_h: Floats  # epochs in hours, shape (t,)
    values: Floats  # in `units`, shape (t, n)

    def check(self, cell: Cell, place: str) -> None:
        """Raise `InputError`, which names the `place`, unless these are parameters of `cell` at epochs in order."""
        shape = (len(self.times_h), len(self.names))
        if self.values.shape != shape or len(self.units) != len(self.names) or not self.names:
            raise InputError(f"{place}: expected as many units as names, and values of shape {shape}")
        if len(set(self.names)) != len(self.names):
            raise InputError(f"{place}: a parameter name stands twice")
        for name, unit in zip(self.names, self.units, strict=True):
            try:
                expected = cell.parameters[name].unit
            except InputError as error:
                raise InputError(f"{place}: {error}") from error
            if unit != expected:
                raise InputError(f"{place}: parameter {name}: expected the unit {expected}, found {unit!r:.40}")
        if not (np.isfinite(self.times_h).all() and np.isfinite(self.values).all()):
            raise InputError(f"{place}: expected finite numbers")
        if len(self.times_h) == 0 or (np.diff(self.times_h) <= 0).any():
            raise InputError(f"{place}: expected epochs in the order of time_h")


@dataclass(frozen=True)
class Truth:
    """True parameter values at epochs: linear between two epochs, constant before the first and after the last."""

    parameters: ParameterSet  # the parameters that have a value; every other one of the cell is nominal
    times_h: Floats  # epochs in hours, increasing, shape (t,)
    values: Floats  # in um and rad, shape (t, n)

    def __repr__(self) -> str:
        return f"Truth({len(self.parameters)} parameters at {len(self.times_h)} times)"

    def at(self, time_h: ArrayLike) -> Floats:
        """Values in um and rad at one time, shape (n,), or at m times, shape (m, n)."""
        times = np.asarray(time_h, dtype=float)
        return np.stack([np.interp(times, self.times_h, column) for column in self.values.T], axis=-1)

    def record(self) -> TruthRecord:
        """The same truth as files hold it."""
        units = tuple(p.unit for p in self.parameters)
        return TruthRecord(self.parameters.names, units, self.times_h, self.parameters.to_shown(self.values))

    @classmethod
    def of_record(cls, record: TruthRecord, cell: Cell, place: str = "truth") -> "Truth":
        """The truth that a record of `cell` tells; `InputError` if it is not one of this cell."""
        record.check(cell, place)
        parameters = ParameterSet(cell.parameters[name] for name in record.names)
        return cls(parameters, record.times_h, parameters.to_internal(record.values))


def paper_truth(cell: Cell) -> Truth:
    """What the paper's full identifications found, as the truth of a simulated cell.

    An identification of the extrinsic parameters alone, with stale intrinsic ones, is no truth and is left out.

    Raises
    ------
    InputError
        If the cell lacks one of the parameters.
    """
    full = [entry for entry in paper_tables()["identification"] if entry["kind"] == "full"]
    # Later tables list what they changed.
    first = full[0]["intrinsic"]
    epochs = [(24.0 * entry["day"], first | entry["intrinsic"] | entry["extrinsic"]) for entry in full]
    return truth_of(cell, epochs, "the paper's truth")


#: A value so many prior standard deviations away is one of another robot.
_FAR = 4.5
#: Sets the draw of a truth off from that of the noise.
_DRAWN = 7


def default_truth(cell: Cell, seed: int) -> Truth:
    """The truth of a simulated cell: the paper's for the paper's robot, else a constant draw of its prior."""
    with contextlib.suppress(InputError):
        paper = paper_truth(cell)
        priors = [cell.parameters[name] for name in paper.parameters.names]
        scores = [abs(v - p.nominal) / p.prior_sd for v, p in zip(paper.values[0], priors, strict=True) if p.prior_sd]
        if max(scores) < _FAR:
            return paper
    drawn = np.random.default_rng([seed, _DRAWN]).standard_normal(len(cell.free))
    values = [
        p.nominal + p.prior_sd * score if p.prior is None else float(p.prior.value(np.array(score)))
        for p, score in zip(cell.free, drawn, strict=True)
    ]
    return Truth(cell.free, np.zeros(1), np.array([values]))


def truth_of(cell: Cell, epochs: list[tuple[float, dict[str, float]]], place: str) -> Truth:
    """The truth with values by name, in um, deg and ppm, at epochs in hours; `place` is for the message."""
    named = {name for _, values in epochs for name in values}
    for name in sorted(named):
        if name not in cell.parameters.names:
            raise InputError(f"{place}: cell {cell.name!r} has no parameter {name}")
    free = set(cell.free.names)
    parameters = ParameterSet(p for p in cell.parameters if p.name in free | named)
    values = np.array([parameters.from_mapping(shown) for _, shown in epochs])
    return Truth(parameters, np.array([time for time, _ in epochs]), values)
