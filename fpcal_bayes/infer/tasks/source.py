"""What a controller may hold: an estimate file, or the draws of a posterior file."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import read_text
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.posterior.netcdf import PosteriorDraws, read_posterior
from fpcal_bayes.infer.tasks.prediction import (
    TaskPrediction,
    central_draw,
    covariance_sd,
    predict_from_covariance,
    predict_from_draws,
)
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.margin import N_DRAWS, estimate_draws, prior_draws
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import MECHANICS_LEFT_OUT
from fpcal_bayes.motion.compensation import compensated
from fpcal_bayes.motion.tasks import Task, find_task


def read_estimate_draws(path: str | Path, cell: Cell, text: str | None = None) -> PosteriorDraws | None:
    """Draws in an estimate file, or its `text`, that `read_estimate` has accepted; None if it holds none."""
    content = json.loads(read_text(Path(path)) if text is None else text)
    stated = content.get("draws")
    if stated is None:
        return None
    parameters = ParameterSet(p for p in cell.parameters if p.name in content["parameters"])
    if not isinstance(stated, dict) or stated.get("names") != list(parameters.names):
        raise InputError(f"{path}: key draws.names: expected the parameters above, in this order")
    try:
        rows = np.array(stated.get("rows"), dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: key draws.rows: expected rows of {len(parameters)} numbers") from error
    if rows.ndim != 2 or rows.shape[1] != len(parameters) or not len(rows) or not np.isfinite(rows).all():
        raise InputError(f"{path}: key draws.rows: expected rows of {len(parameters)} finite numbers, one or more")
    return PosteriorDraws(cell, parameters, parameters.to_internal(rows))


#: Points of a path on a perfect mechanism, where their number changes nothing.
_IDEAL_POINTS = 61
#: On a machine return errors make a peak to peak grow with their number, so it is fixed and stated.
PATH_POINTS = 31
#: Draws of a posterior that are propagated at most.
_MOST_DRAWS = 20_000


def path_points(estimate: Estimate) -> int:
    """Points of a path where nobody asks for another number."""
    return _IDEAL_POINTS if estimate.mechanics is None else PATH_POINTS


@dataclass(frozen=True)
class Knowledge:
    """What is known of a cell's parameters when a task is planned."""

    cell: Cell
    estimate: Estimate | None  # what the controller holds; None: the draws say (see `central_draw`)
    draws: PosteriorDraws | None  # of the posterior; None where there is only the covariance

    def held(self, task: str, *, radius: float | None = None) -> Estimate:
        """The estimate that the controller holds for a task."""
        if self.draws is None or self.estimate is not None:
            assert self.estimate is not None
            return self.estimate
        free, draws = self.draws.parameters, self.draws.values
        values = central_draw(CavityModel.of(self.cell, free), draws, task, radius=radius)
        covariance = (draws - values).T @ (draws - values) / len(draws)
        return Estimate(self.cell, free, values, covariance, ("identified",) * len(free), trust=self.draws.trust)

    def predict(self, estimate: Estimate, task: Task, *, draws: int = 10_000, seed: int = 0) -> TaskPrediction:
        """The distribution of the error of a task that was found with `estimate`."""
        if self.draws is None:
            return predict_from_covariance(estimate, task, draws=draws, seed=seed)
        free = self.draws.parameters
        model = CavityModel.of(self.cell, free, estimate.vector())
        trust = self.draws.trust.because(*estimate.trust.reasons)
        return predict_from_draws(model, self.draws.values, estimate.vector()[free.slots], task, trust)

    def sd(self, estimate: Estimate, task: Task) -> Floats:
        """Standard deviation of the error at each point, shape (n_points,), in um."""
        return covariance_sd(estimate, task) if self.draws is None else self.predict(estimate, task).sd

    def drawn(self, estimate: Estimate) -> tuple[CavityModel, Floats]:
        """The model, and draws of what is known: the posterior's, the covariance's; the prior's of no usable one."""
        if not estimate.trust.usable:
            return prior_draws(self.cell)
        if self.draws is None:
            return estimate_draws(estimate)
        return CavityModel.of(self.cell, self.draws.parameters, estimate.vector()), self.draws.values[:N_DRAWS]

    def plan(
        self, task: str, *, radius: float | None = None, n_points: int | None = None, compensate: bool = True
    ) -> tuple[Estimate, Task]:
        """The estimate that the controller holds, and its path, which makes up for error motions where that gains."""
        estimate = self.held(task, radius=radius)
        n_points = n_points or path_points(estimate)
        found = find_task(self.cell, estimate.vector(), task, radius=radius, n_points=n_points)
        return estimate, compensated(estimate, found) if compensate and self.draws is None else found


def read_knowledge(
    path: str | Path, cell: Cell, *, held: str | Path | None = None, text: str | None = None
) -> Knowledge:
    """Read an estimate JSON or its `text`, or posterior draws (``.nc``) with the estimate that a controller `held`."""
    estimate = None if held is None else read_estimate(held, cell)
    if Path(path).suffix.lower() == ".nc":
        draws = read_posterior(path, cell).thinned(_MOST_DRAWS)
        trust = draws.trust if cell.mechanics is None else draws.trust.because(MECHANICS_LEFT_OUT)
        return Knowledge(cell, estimate, replace(draws, trust=trust))
    if held is not None:
        raise InputError(f"{held}: an estimate to hold is taken beside posterior draws (.nc) only, not beside {path}")
    estimate = read_estimate(path, cell, text)
    return Knowledge(cell, estimate, read_estimate_draws(path, cell, text))
