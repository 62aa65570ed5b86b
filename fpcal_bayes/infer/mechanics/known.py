"""What a fit with mechanics knows, small enough to travel with an estimate."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from itertools import count

import numpy as np
from scipy import linalg

from fpcal_bayes.core.linalg import symmetric
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.mechanics.fit import MechanicsFit
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.mechanics.design import path_design
from fpcal_bayes.model.mechanics.knowledge import MechanicsKnowledge
from fpcal_bayes.model.parameters import ParameterSet

#: Poses anywhere in the joints' limits at which the directions are judged.
_POSES = 240
#: Directions whose effect is below this, in um, root mean square over poses, are cut.
_NEGLIGIBLE = 1e-4
_MOST_DIRECTIONS = 60


def knowledge_of_fit(fit: MechanicsFit, parameters: ParameterSet, free: Collection[str]) -> MechanicsKnowledge:
    """Draws of geometry and weights, turned to the directions that a cavity length or the mirror's pose feels.

    Of the estimate's `parameters` those named in `free` were moved; what is neither free nor considered is exact.
    """
    problem, terms = fit.problem, fit.terms
    draws = fit.few_draws
    n, names = fit.design.motion_count, fit.design.names
    kept = [i for i, name in enumerate(names) if i < n or name.startswith("drift along")]
    geometry, known = _deviations(fit, draws.scores, free)
    changes = np.hstack([geometry, draws.weights[:, kept]])
    mean = changes.mean(axis=0)
    changes = changes - mean

    vector = problem.model.vector(fit.values)
    cell = terms.cell
    middle, poses = random_poses(cell, np.random.default_rng([fit.seed, 4]))
    model = CavityModel.of(cell, ParameterSet(parameters[name] for name in known), vector)
    rows = model.rows(np.repeat(middle[None], _POSES, axis=0), poses)
    _, jacobian = model.predict_with_jacobian(vector[model.free.slots], rows)
    path = path_design(terms, vector, middle, poses)
    drift = np.zeros((_POSES, len(kept) - n))
    for k in range(drift.shape[1]):
        drift[:, k] = path.drift[:, k % 3] * terms.sizes.drift_nm_per_min * 1e-3 * fit.drive.session_min
    effects = changes @ np.hstack([jacobian, path.motions, drift]).T
    # The pose rests on more of the geometry than lengths feel: one standard deviation of the prior counts as 1 um.
    scores = np.sqrt(_POSES) * geometry / np.where(model.free.prior_sd > 0, model.free.prior_sd, np.inf)
    left, sizes, _ = linalg.svd(np.hstack([effects, scores - scores.mean(axis=0)]), full_matrices=False)
    felt = int((sizes > _NEGLIGIBLE * np.sqrt(effects.size)).sum())
    z = left[:, : min(felt, _MOST_DIRECTIONS)] * np.sqrt(len(changes))
    directions = (*known, *numbered(names[i] for i in kept)), mean, changes.T @ z / len(changes), z
    scales = terms.scales, draws.log_scales, fit.drive.session_min
    return MechanicsKnowledge(terms.sizes, problem.model.free.names, *directions, *scales)


def random_poses(cell: Cell, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The middle of the joints' travels (n_joints,), and poses anywhere in them, shape (n_poses, n_joints)."""
    endless = ~np.isfinite(cell.high - cell.low)
    low, high = np.where(endless, -np.pi, cell.low), np.where(endless, np.pi, cell.high)
    return np.where(endless, 0.0, 0.5 * (low + high)), rng.uniform(low, high, (_POSES, len(low)))


def covariance_of(fit: MechanicsFit) -> Floats:
    """Covariance of free and considered parameters over the mixture of scales in um and rad, shape (n, n)."""
    problem, n = fit.problem, fit.problem.n_free
    scores = fit.moments()[1]
    slopes = problem.prior.secants(fit.solution.unknowns[:n], np.sqrt(np.diag(scores)[:n]))
    if problem.considered is not None:
        slopes = linalg.block_diag(slopes, problem.considered.factor)
    return symmetric(slopes @ scores @ slopes.T)


def _deviations(fit: MechanicsFit, scores: Floats, moved: Collection[str]) -> tuple[Floats, tuple[str, ...]]:
    """Deviations (n_draws, n) of free and held parameters from the estimate to first order, and their names."""
    problem, at = fit.problem, fit.solution.unknowns
    n = problem.n_free
    held = np.array([name not in moved for name in problem.model.free.names])
    centre = np.where(held, problem.unknowns(problem.model.free.nominal)[:n], at[:n])
    free = (scores[:, :n] - centre) @ problem.prior.slopes(at[:n]).T
    if problem.considered is None:
        return free, problem.model.free.names
    held = scores[:, n:] @ problem.considered.factor.T
    return np.hstack([free, held]), (*problem.model.free.names, *problem.considered.parameters.names)


def numbered(names: Iterable[str]) -> list[str]:
    """Names with the number of the weight within its term, in brackets."""
    counts: defaultdict[str, Iterator[int]] = defaultdict(lambda: count(1))
    return [f"{name} [{next(counts[name])}]" for name in names]
