"""A study whose replicates cost next to nothing, importable by workers."""

import os
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from fpcal_bayes.study.base import Results, Study, Summary


@dataclass(frozen=True, kw_only=True)
class ToyStudy(Study):
    """Random numbers, a NaN now and then; replicate `failing` raises an error, `deadly` kills its worker."""

    name: ClassVar[str] = "toy"

    failing: int = -1
    deadly: int = -1

    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"normal": (3,), "number": ()}

    def settings(self) -> dict[str, Any]:
        return {"toy": True}

    def replicate(self, number: int) -> dict[str, np.ndarray]:
        if number == self.failing:
            raise ZeroDivisionError("one over nothing")
        if number == self.deadly:
            os._exit(1)
        normal = self.random(number).standard_normal(3)
        normal[number % 3] = np.nan if number % 5 == 0 else normal[number % 3]
        return {"normal": normal, "number": np.array(float(number))}

    def summary(self, results: Results) -> Summary:
        return Summary("toy", [{"n": len(results["number"])}])
