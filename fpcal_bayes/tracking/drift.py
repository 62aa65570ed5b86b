"""How parameters drift: the state that holds them and what drives them, and its step through time."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import covariance_root, identity, symmetric
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import DriftSize
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.tracking.motions import MotionStates

HOURS_PER_DAY = 24.0
#: A pace that is nearer to one is not worth a word.
_WORTH_SAYING = 1.5


@dataclass(frozen=True, repr=False)
class State(Brief):
    """What is known at a time."""

    time_h: float  # hours since the campaign began
    mean: Floats  # of the states of a `DriftModel`, shape (n_states,)
    covariance: Floats  # shape (n_states, n_states)
    temperature_c: float = float("nan")  # last temperature that was logged, or NaN


@dataclass(frozen=True)
class Transition:
    """One step in time: x becomes ``matrix @ x + shift`` plus noise of covariance `noise`."""

    matrix: Floats  # shape (n_states, n_states)
    noise: Floats  # likewise
    shift: Floats  # shape (n_states,)


@dataclass(frozen=True, repr=False)
class DriftModel(Brief):
    """Drift of a set of parameters.

    The state holds the parameters, from nominal in prior standard deviations, the error motions, which stay, then what
    drives the parameters: rates, returning motions, temperature coefficients, in their own standard deviations.
    """

    parameters: ParameterSet  # the parameters that are followed
    sizes: tuple[DriftSize, ...]  # one per parameter, in the same order
    # variance after one day beyond the random walks, in scaled units, shape (n_parameters, n_parameters), or None (see
    # `with_hidden_noise`)
    hidden: Floats | None = field(default=None, compare=False)
    motions: MotionStates | None = field(default=None, compare=False)  # of a machine, as its calibration found them
    pace: tuple[float, float] = (1.0, 1.0)  # robot's, and mirror's and fibre's, times the stated walk

    @classmethod
    def of(cls, cell: Cell, parameters: ParameterSet | None = None) -> "DriftModel":
        """The drift that a cell states, of its free parameters by default."""
        if not cell.drift:
            raise InputError(
                f"cell {cell.name!r} states no drift: expected it in its file, for example "
                "[extrinsic.drift] x_wf = { walk_um = 0.5 } (per square-root day)"
            )
        parameters = cell.free if parameters is None else parameters
        known = {size.name: size for size in cell.drift}
        return cls(parameters, tuple(known.get(name, DriftSize(name)) for name in parameters.names))

    def resized(self, change: Callable[[DriftSize], DriftSize]) -> "DriftModel":
        """The same model with each size replaced by `change` of it, without `hidden`."""
        return replace(self, sizes=tuple(change(size) for size in self.sizes), hidden=None)

    @cached_property
    def n_parameters(self) -> int:
        """Number of parameters, which come first in the state."""
        return len(self.parameters)

    @cached_property
    def n_lengths(self) -> int:
        """Number of states that cavity lengths depend on, which come first: parameters and error motions."""
        return self.n_parameters + (0 if self.motions is None else self.motions.n_states)

    @cached_property
    def n_states(self) -> int:
        """Length of the state."""
        return self.n_lengths + sum(map(len, self._driven))

    @cached_property
    def scale(self) -> Floats:
        """Units of the parameter states in um and rad, shape (n_parameters,)."""
        return self.parameters.prior_sd

    @cached_property
    def walk(self) -> Floats:
        """Random walk after one day in scaled units, shape (n_parameters,)."""
        return np.array([size.walk for size in self.sizes]) * np.where(self.extrinsic, *self.pace[::-1]) / self.scale

    @cached_property
    def drifting(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the parameters that walk: of the robot, and of mirror and fibre."""
        walks = [(p.name, p.kind) for p, size in zip(self.parameters, self.sizes, strict=True) if size.walk]
        robot, mirror = (tuple(name for name, kind in walks if kind == which) for which in ("intrinsic", "extrinsic"))
        return robot, mirror

    @property
    def pace_note(self) -> str | None:
        """In words, how far the pace is from what the cell states; None where it is near."""
        told = [
            f"{', '.join(names)}: {pace:.2g} times"
            for names, pace in zip(self.drifting, self.pace, strict=True)
            if not 1.0 / _WORTH_SAYING < pace < _WORTH_SAYING
        ]
        word = "faster" if np.prod(self.pace) > 1.0 else "slower"
        advice = "forecasts take it so; fpcal track --fit-drift gives sizes for the cell"
        return f"drift {word} than stated ({'; '.join(told)}): {advice}" if told else None

    @cached_property
    def extrinsic(self) -> NDArray[np.bool_]:
        """Whether each parameter belongs to mirror or fibre, shape (n_parameters,)."""
        return np.array([p.kind == "extrinsic" for p in self.parameters])

    @cached_property
    def _driven(self) -> tuple[list[int], ...]:
        """Positions of the parameters with a rate, with a returning motion, with a part of the temperature."""
        parts = zip(*((s.rate_sd > 0, s.bounded_sd > 0, s.temperature_sd > 0) for s in self.sizes), strict=True)
        return tuple(np.flatnonzero(part).tolist() for part in parts)

    def initial(self, values: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Mean and covariance of the state after a calibration in um and rad; what drives it starts at its prior."""
        n = self.n_parameters
        mean, full = np.zeros(self.n_states), np.eye(self.n_states)
        mean[:n] = (values - self.parameters.nominal) / self.scale
        full[:n, :n] = covariance / np.outer(self.scale, self.scale)
        return mean, full

    def values(self, mean: Floats) -> Floats:
        """Parameters in um and rad of states (..., n_states)."""
        return self.parameters.nominal + self.scale * mean[..., : self.n_parameters]

    def covariance(self, covariance: Floats) -> Floats:
        """Covariance of the parameters in um and rad of a state covariance (n_states, n_states)."""
        n = self.n_parameters
        return covariance[:n, :n] * np.outer(self.scale, self.scale)

    def transition(self, hours: float, kelvin: float = 0.0) -> Transition:
        """The step over some hours, in which the logged temperature changed by `kelvin`."""
        n, days = self.n_parameters, hours / HOURS_PER_DAY
        noise, shift = np.zeros((self.n_states, self.n_states)), np.zeros(self.n_states)
        noise[np.arange(n), np.arange(n)] = days * self.walk**2
        if self.hidden is not None:
            noise[:n, :n] += self.hidden * days
        if kelvin:
            shift[:n] = kelvin * np.array([size.temperature for size in self.sizes]) / self.scale
        at = self.n_lengths
        if at == self.n_states:
            return Transition(identity(at), noise, shift)
        matrix, (rates, bounded, sensitive) = np.eye(self.n_states), self._driven
        for i in rates:
            matrix[i, at] = days * self.sizes[i].rate_sd / self.scale[i]
            at += 1
        for i in bounded:
            size = self.sizes[i]
            kept = float(np.exp(-hours / size.bounded_hours))
            # The parameter is a constant plus the returning motion: both take the same step.
            step = np.array([size.bounded_sd / self.scale[i], 1.0])
            matrix[i, at], matrix[at, at] = (kept - 1.0) * step[0], kept
            noise[np.ix_([i, at], [i, at])] += (1.0 - kept**2) * np.outer(step, step)
            at += 1
        for i in sensitive:
            matrix[i, at] = kelvin * self.sizes[i].temperature_sd / self.scale[i]
            at += 1
        return Transition(matrix, noise, shift)

    def propagate(self, mean: Floats, covariance: Floats, hours: float, kelvin: float = 0.0) -> tuple[Floats, Floats]:
        """Mean (n_states,) and covariance (n_states, n_states) of a state some hours later; see `transition`."""
        step = self.transition(hours, kelvin)
        if self.n_states == self.n_lengths:
            # Nothing drives the parameters: the matrix is one.
            return mean + step.shift, covariance + step.noise
        return step.matrix @ mean + step.shift, symmetric(step.matrix @ covariance @ step.matrix.T) + step.noise


#: A steady rate makes in a day what the random walk makes; a kelvin what it makes in six hours, in which a room may
#: well warm by one. Both are standard deviations of what is unknown, found by the filter.
_RATE_DAYS, _KELVIN_DAYS = 1.0, 0.25


def likely_drift(cell: Cell, sweeps: Sweeps) -> DriftModel:
    """The drift that a cell states; where it states walks alone and a temperature is logged, with `likely_terms`."""
    stated = DriftModel.of(cell)
    walks_only = all(size == DriftSize(size.name, walk=size.walk) for size in stated.sizes)
    return likely_terms(stated) if bool(np.isfinite(sweeps.temperature_c).any()) and walks_only else stated


def likely_terms(drift: DriftModel) -> DriftModel:
    """The drift with a steady rate and a temperature's part of each drifting angle of mirror and fibre."""
    angles = {p.name for p in drift.parameters if p.kind == "extrinsic" and p.unit == "deg"}

    def change(size: DriftSize) -> DriftSize:
        if size.name not in angles or not size.walk:
            return size
        return replace(size, rate_sd=size.walk / np.sqrt(_RATE_DAYS), temperature_sd=size.walk * np.sqrt(_KELVIN_DAYS))

    return drift.resized(change)


def propagated(estimate: Estimate, hours: float) -> Estimate:
    """An estimate `hours` later: its covariance has grown by the cell's drift."""
    drift = DriftModel.of(estimate.cell, estimate.parameters)
    _, later = drift.propagate(*drift.initial(estimate.values, estimate.covariance), hours)
    return replace(estimate, covariance=drift.covariance(later))


def drift_root(cell: Cell, parameters: ParameterSet, hours: float) -> Floats | None:
    """Square root (n, k), in um and rad, of the covariance by which parameters drift in some hours; None if none do."""
    if not cell.drift or hours == 0.0:
        return None
    drift = DriftModel.of(cell, parameters)
    start = np.eye(drift.n_states)
    start[: drift.n_parameters, : drift.n_parameters] = 0.0
    _, later = drift.propagate(np.zeros(drift.n_states), start, abs(hours))
    return covariance_root(drift.covariance(later), parameters.prior_sd)
