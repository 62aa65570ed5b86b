"""An estimate: values, covariance and provenance of a cell's parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fpcal_bayes.core.notebook import Result
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cell.cell import Cell, describe
from fpcal_bayes.model.mechanics.knowledge import MechanicsKnowledge
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import Trust

SCHEMA = "fpcal/1"
#: What a file says of mechanics where none were taken into account.
PERFECT: dict[str, Any] = {"names": [], "assumed": "a perfect mechanism: no error motion, reversal or return error"}
STATUSES = ("identified", "weak", "gauge", "fixed")


@dataclass(frozen=True)
class Estimate(Result):
    """Values and covariance of a cell's parameters at a time."""

    cell: Cell  # the cell it belongs to
    parameters: ParameterSet  # in the cell's order
    values: Floats  # in um and rad, shape (n,)
    covariance: Floats  # in um and rad, shape (n, n); zero rows where a parameter is held as exact
    status: tuple[str, ...]  # ``identified``, ``weak``, ``gauge`` or ``fixed``, one per parameter
    time_h: float = 0.0  # hours since the campaign began
    valid_until_h: float | None = None  # until when it may be used, or None where nobody has worked that out
    data: dict[str, str] = field(default_factory=dict)  # name and hash of the file it was made from
    trust: Trust = field(default_factory=Trust)  # whether it may be used, and what is held against it
    mechanics: MechanicsKnowledge | None = None  # error motions with these parameters; None: perfect mechanism
    curve: Floats | None = (
        None  # sd that gauges add by their bend, (n,) or none: no length feels it, nor the covariance
    )

    @property
    def sd(self) -> Floats:
        """Standard deviations in um and rad, shape (n,)."""
        return np.hypot(np.sqrt(np.diag(self.covariance)), 0.0 if self.curve is None else self.curve)

    def __repr__(self) -> str:
        return f"Estimate({len(self.parameters)} parameters of {self.cell.name!r} at {self.time_h:g} h)"

    def __getitem__(self, name: str) -> dict[str, Any]:
        """Value, standard deviation, unit, prior and status of one parameter, in the units a person reads."""
        at = self.parameters.position(name)
        p = self.parameters[at]
        told = {"unit": p.unit, "prior_sd": p.shown(p.prior_sd), "status": self.status[at]}
        bend = {} if self.curve is None or not self.curve[at] else {"curve_sd": p.shown(float(self.curve[at]))}
        return {"value": p.shown(float(self.values[at])), "sd": p.shown(float(self.sd[at])), **told, **bend}

    def vector(self) -> Floats:
        """Model vector (model size,) with these values, the rest nominal."""
        vector = self.cell.parameters.nominal.copy()
        vector[self.parameters.slots] = self.values
        return vector

    def shown(self) -> dict[str, dict[str, Any]]:
        """What is known of each parameter, by name."""
        return {name: self[name] for name in self.parameters.names}

    def block(self, names: Sequence[str]) -> tuple[Floats, Floats]:
        """Values (n,) and covariance (n, n) of some parameters, in um and rad."""
        chosen = self.parameters.positions(names)
        return self.values[chosen], self.covariance[np.ix_(chosen, chosen)]

    def content(self) -> dict[str, Any]:
        """The JSON content: parameters, covariance, cell, data, times."""
        uncertain = np.flatnonzero(np.diag(self.covariance)).tolist()
        scales = self.parameters.scales[uncertain]
        matrix = self.covariance[np.ix_(uncertain, uncertain)] / np.outer(scales, scales)
        return {
            "parameters": self.shown(),
            "covariance": {"names": [self.parameters.names[i] for i in uncertain], "matrix": matrix.tolist()},
            "cell": describe(self.cell),
            "data": self.data,
            "time_h": self.time_h,
            "valid_until_h": self.valid_until_h if self.trust.usable else None,
            "trust": self.trust.content(),
            "mechanics": PERFECT if self.mechanics is None else self.mechanics.content(self.parameters),
        }
