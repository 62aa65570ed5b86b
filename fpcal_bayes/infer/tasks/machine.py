"""The error of a task on a machine: what geometry, error motions and return leave unknown along its path."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_jacobian
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics import PathDesign, Terms, path_design
from fpcal_bayes.model.mechanics.design import drift_sd
from fpcal_bayes.model.mechanics.terms import DRIFT_ORDER
from fpcal_bayes.motion.tasks import Task

#: Points of a path: return errors make a peak to peak grow with their number, so it is fixed and stated.
PATH_POINTS = 31
#: The draws that an estimate hands on are a few hundred: more than this tell nothing new.
_MOST_DRAWS = 4000


@dataclass(frozen=True)
class MechanicsTaskErrors:
    """Draws of a task's error along its path, in um.

    Attributes
    ----------
    repeatable
        By geometry, error motions, reversal and encoders: the same each time, shape (n_draws, n_points).
    returned
        By return errors: another one each time, same shape.
    """

    repeatable: Floats
    returned: Floats

    @property
    def total(self) -> Floats:
        """Both, shape (n_draws, n_points)."""
        return self.repeatable + self.returned

    def peak_to_peak_band(self, share: float = 0.95) -> Floats:
        """Lower and upper edge of the peak to peak of the total, shape (2,)."""
        return np.quantile(peak_to_peak(self.total), [(1 - share) / 2, (1 + share) / 2])

    def band(self, share: float = 0.95) -> Floats:
        """Lower and upper edge at each point, shape (2, n_points)."""
        return np.quantile(self.total, [(1 - share) / 2, (1 + share) / 2], axis=0)


def mechanics_task_errors(fit: MechanicsFit, task: Task, *, seed: int = 0) -> MechanicsTaskErrors:
    """Draw the error of a task that was found with the fit's own geometry.

    The errors are of first order in what is unknown. The task is driven point by point from its aligned pose, which was
    reached from an unknown side, at some time of the session.
    """
    rng = np.random.default_rng([seed, 2])
    draws, model = fit.draws, fit.problem.model
    at = fit.solution.unknowns[: fit.problem.n_free]
    jacobian = fit.problem.prior.by_scores(task_jacobian(model, fit.values, task), at)
    path = path_design(fit.terms, model.vector(fit.values), task.start, task.q)
    change = draws.scores[:, : fit.problem.n_free] - at
    repeatable = change @ jacobian.T + draws.weights[:, : fit.design.motion_count] @ path.motions.T
    drifting = [i for i, name in enumerate(fit.design.names) if name.startswith("drift along")]
    session_min = float(fit.drive.end_min.max())
    repeatable += sum(_approached(fit.terms, path, draws.log_scales, rng).values())
    repeatable += _drifted(fit.terms, path, draws.weights[:, drifting], session_min, rng)
    returned = np.sum([np.zeros_like(repeatable), *_returned(fit.terms, path, draws.log_scales, rng).values()], axis=0)
    return MechanicsTaskErrors(repeatable, returned)


def known_task_errors(
    estimate: Estimate, start: Floats, q: Floats, *, draws: int = 10_000, seed: int = 0
) -> tuple[MechanicsTaskErrors, Floats, dict[str, Floats]]:
    """Draw the error along a path with what an estimate knows of geometry and error motions.

    Parameters
    ----------
    start, q
        The path is driven point by point from `start` (n_joints,) along `q` (n_points, n_joints).

    Returns
    -------
    tuple
        The errors; the deviations of the estimate's parameters, shape (n_draws, n_parameters); and by its name what
        each cause adds along the path, shape (n_draws, n_points) each.
    """
    knowledge, cell = estimate.mechanics, estimate.cell
    if knowledge is None:
        raise InputError("the estimate knows nothing of the cell's mechanics")
    rng, draws = np.random.default_rng([seed, 2]), min(draws, _MOST_DRAWS)
    terms, parameters = knowledge.terms(cell), estimate.parameters
    model = CavityModel.of(cell, parameters)
    rows = model.rows(np.repeat(start[None], len(q), axis=0), q)
    _, jacobian = model.predict_with_jacobian(estimate.values, rows)
    path = path_design(terms, estimate.vector(), start, q)
    chosen = rng.permutation(np.arange(draws) % len(knowledge.draws))
    z, log_scales = knowledge.draws[chosen], knowledge.log_scales[chosen]
    mean, factor = knowledge.geometry(parameters.names)
    change = mean + z @ factor.T
    names, mean, factor = knowledge.weights(knowledge.n_parameters)
    weights = mean + z @ factor.T
    words = [name.rpartition(" [")[0] for name in names]
    drifting = np.array([word.startswith("drift along") for word in words], dtype=bool)

    parts = {"geometry": change @ jacobian.T}
    moved = np.flatnonzero(~drifting)
    if len(moved) != path.motions.shape[1]:
        raise InputError("the estimate was made with other mechanics than the cell states: identify the cell anew")
    for word in dict.fromkeys(words[i] for i in moved):
        own = [k for k, i in enumerate(moved) if words[i] == word]
        parts[word] = weights[:, moved[own]] @ path.motions[:, own].T
    parts |= _approached(terms, path, log_scales, rng)
    if drifting.any():
        parts["drift"] = _drifted(terms, path, weights[:, drifting], knowledge.session_min, rng)
    repeatable = np.sum(list(parts.values()), axis=0)
    returned = _returned(terms, path, log_scales, rng)
    made = MechanicsTaskErrors(repeatable, np.sum([np.zeros_like(repeatable), *returned.values()], axis=0))
    return made, change, parts | returned


def _approached(terms: Terms, path: PathDesign, log_scales: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Reversal before a joint's first move, from an unknown side, by joint."""
    if not path.unknown_side.any():
        return {}
    approach = np.exp(log_scales[:, terms.scales.index("approach")])
    signs = approach[:, None] * rng.choice([-1.0, 1.0], (len(log_scales), path.unknown_side.shape[1]))
    return {
        f"first approach of q{i + 1}": signs[:, [i]] * path.unknown_side[:, i]
        for i in np.flatnonzero(path.unknown_side.any(axis=0)).tolist()
    }


def _drifted(terms: Terms, path: PathDesign, weights: Floats, session_min: float, rng: np.random.Generator) -> Floats:
    """Where the fibre had drifted to at some time of the session."""
    if not weights.shape[1]:
        return np.zeros((len(weights), len(path.drift)))
    sd = drift_sd(terms, session_min)
    when = rng.uniform(-1.0, 1.0, len(weights))
    values = np.column_stack([when, 1.5 * when**2 - 0.5])[:, :DRIFT_ORDER]
    by_order = weights.reshape(len(weights), DRIFT_ORDER, 3)
    moved: Floats = (by_order * (values * sd)[:, :, None]).sum(axis=1)
    return moved @ path.drift.T


def _returned(terms: Terms, path: PathDesign, log_scales: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Return errors of the joints, another one at each position that is reached, by joint."""
    factor = np.exp(log_scales[:, terms.scales.index("return")])[:, None]
    found = {}
    for joint in np.flatnonzero(path.returned_point.any(axis=0)).tolist():
        reached = rng.standard_normal((len(log_scales), int(path.steps[:, joint].max(initial=0)) + 1))
        at_points = factor * (reached[:, path.steps[:, joint]] * path.returned_point[:, joint])
        found[f"return of q{joint + 1}"] = at_points - factor * reached[:, :1] * path.returned_start[:, joint]
    return found
