"""What a study is: replicates that depend on their number alone, and what they say together."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from fpcal_bayes.core.files import content_sha256
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cell.cell import Cell

#: Replicates, one per row, by the name of what they give: shape (n_replicates, *shape of the value).
Results = Mapping[str, Floats]


@dataclass(frozen=True)
class Summary:
    """What the replicates of a study say together."""

    title: str
    # one mapping of column to value each, all with the same columns; the first holds names
    rows: list[dict[str, str | int | float]]
    sentences: list[str] = field(default_factory=list)  # results in words
    warnings: list[str] = field(default_factory=list)  # what is not to be trusted


@dataclass(frozen=True, kw_only=True)
class Study(ABC):
    """One question and all its settings."""

    name: ClassVar[str]

    cell: Cell  # the cell that is simulated
    seed: int = 0  # of all random numbers; each replicate mixes its own number in

    @abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the numbers that one replicate gives."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All that a replicate depends on beside cell, seed and number, as JSON."""

    @abstractmethod
    def replicate(self, number: int) -> dict[str, Floats]:
        """Replicate `number`, from 0 on, the same wherever it runs; NaN stands where it gives nothing."""

    @abstractmethod
    def summary(self, results: Results) -> Summary:
        """What the replicates say."""

    def random(self, number: int) -> np.random.Generator:
        """Random numbers of replicate `number`."""
        return np.random.default_rng([self.seed, number])


def drawn_truth(cell: Cell, random: np.random.Generator) -> Truth:
    """A cell drawn from the prior, which does not drift."""
    return Truth(cell.free, np.zeros(1), Prior.of(cell.free).values(random.standard_normal(len(cell.free)))[None])


def sweeps_sha256(sweeps: Sweeps) -> str:
    """Hash of where sweeps lead and how their rows belong together."""
    columns = (sweeps.q_start, sweeps.q_end, sweeps.signed, sweeps.group, sweeps.kind)
    return content_sha256([column.tolist() for column in columns])
