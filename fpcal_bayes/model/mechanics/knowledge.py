"""What is known of a machine: its geometry and its error motions together, as draws in the directions that count."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.error_motions import Mechanics
from fpcal_bayes.model.mechanics.terms import Terms
from fpcal_bayes.model.parameters import ParameterSet

#: Decimals in a file of draws, weights and logarithms of factors, all of about unit size, and digits of the rest.
_DRAWN, _WEIGHT, _FACTOR, _DIGITS = 2, 4, 3, 6


@dataclass(frozen=True, repr=False)
class MechanicsKnowledge(Brief):
    """Geometry and weights of the error motions, x = mean + factor z; z is drawn, and has unit variance."""

    sizes: Mechanics  # what the cell states
    free: tuple[str, ...]  # geometric parameters that were identified; weights that say the same stand aside for them
    names: tuple[str, ...]  # of the parameters, then of the weights, n of them
    # of the parameters' deviations from the estimate in um and rad, and of the weights in units of their stated sizes,
    # shape (n,)
    mean: Floats
    factor: Floats  # shape (n, n_directions)
    draws: Floats  # equally likely values of z, shape (n_draws, n_directions)
    scales: tuple[str, ...]  # names of the factors on the stated sizes
    log_scales: Floats  # their logarithms in the same draws, shape (n_draws, n_scales)
    session_min: float  # how long the session took, in minutes
    _terms: dict[str, Terms] = field(default_factory=dict, repr=False, compare=False)

    def terms(self, cell: Cell) -> Terms:
        """The weights of the cell."""
        if cell.sha256 not in self._terms:
            self._terms[cell.sha256] = Terms.of(cell, self.sizes, self.free)
        return self._terms[cell.sha256]

    def geometry(self, names: Sequence[str]) -> tuple[Floats, Floats]:
        """Mean (n_names,) and factor (n_names, n_directions) of some parameters; zero of those held as exact."""
        known = {name: i for i, name in enumerate(self.names)}
        mean, factor = np.zeros(len(names)), np.zeros((len(names), self.factor.shape[1]))
        for k, name in enumerate(names):
            if name in known:
                mean[k], factor[k] = self.mean[known[name]], self.factor[known[name]]
        return mean, factor

    def weights(self, n_parameters: int) -> tuple[tuple[str, ...], Floats, Floats]:
        """Names, mean and factor of the weights, behind `n_parameters` parameters."""
        return self.names[n_parameters:], self.mean[n_parameters:], self.factor[n_parameters:]

    @cached_property
    def known_motions(self) -> tuple[Floats, float]:
        """Posterior mean of the weights that a task shares, shape (n_weights,), and typical factor on return errors."""
        names, mean, _ = self.weights(self.n_parameters)
        shared = [not name.startswith("drift along") for name in names]
        return mean[shared], float(np.exp(self.log_scales[:, self.scales.index("return")].mean()))

    @cached_property
    def n_parameters(self) -> int:
        """How many of the names are parameters: those without a number in brackets."""
        return sum(not name.endswith("]") for name in self.names)

    def content(self, parameters: ParameterSet) -> dict[str, Any]:
        """The JSON content; parameters in um and deg."""
        n = self.n_parameters
        scale = parameters.scales[parameters.positions(self.names[:n])]
        low, middle, high = np.exp(np.quantile(self.log_scales, [0.025, 0.5, 0.975], axis=0))
        return {
            "names": list(self.names),
            "mean": [*_short(self.mean[:n] / scale), *np.round(self.mean[n:], _WEIGHT).tolist()],
            "factor": [*map(_short, self.factor[:n] / scale[:, None]), *np.round(self.factor[n:], _WEIGHT).tolist()],
            "draws": np.round(self.draws, _DRAWN).tolist(),
            "free": list(self.free),
            "session_min": self.session_min,
            "sizes_sha256": self.sizes.sha256,
            "scales": {
                name: {"median": float(middle[i]), "low": float(low[i]), "high": float(high[i]), "share": 0.95}
                for i, name in enumerate(self.scales)
            },
            "log_scales": np.round(self.log_scales, _FACTOR).tolist(),
        }


def knowledge_of(content: dict[str, Any], sizes: Mechanics, parameters: ParameterSet, cell: Cell) -> MechanicsKnowledge:
    """What `MechanicsKnowledge.content` wrote, zero for orders that older files lack; `ValueError` if damaged."""
    names, free, scales = (tuple(map(str, content[key])) for key in ("names", "free", "scales"))
    mean, factor, draws, log_scales = (
        np.array(content[key], dtype=float) for key in ("mean", "factor", "draws", "log_scales")
    )
    session_min = float(content["session_min"])
    directions = factor.shape[1] if factor.ndim == 2 else -1
    shapes = (mean.shape, factor.shape, draws.shape[1:], log_scales.shape)
    if shapes != ((len(names),), (len(names), directions), (directions,), (len(draws), len(scales))) or not len(draws):
        raise ValueError("names, mean, factor, draws and log_scales do not fit each other")
    if not all(np.isfinite(part).all() for part in (mean, factor, draws, log_scales, session_min)):
        raise ValueError("expected finite numbers")
    made = MechanicsKnowledge(sizes, free, names, mean, factor, draws, scales, log_scales, session_min)
    first = names[: made.n_parameters]
    if not all(name in parameters for name in (*first, *free)):
        raise ValueError("expected names of the parameters, then those of weights")
    scale = np.ones(len(names))
    scale[: len(first)] = parameters.scales[parameters.positions(first)]
    motions = made.terms(cell).motions
    felt = [f"{motion.name} [{k + 1}]" for motion in motions for k in range(int((motion.sd > 0).sum()))]
    names = (*first, *felt, *(name for name in names[len(first) :] if name not in felt))
    held = [made.names.index(name) if name in made.names else len(made.names) for name in names]
    mean, factor = np.append(mean * scale, 0.0), np.vstack([factor * scale[:, None], np.zeros(directions)])
    return replace(made, names=names, mean=mean[held], factor=factor[held])


def _short(values: Floats) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]
