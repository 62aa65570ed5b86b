"""The error along a path that a machine is driven on: what geometry, error motions and return leave unknown."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics.design import PathDesign, drift_sd, path_design, pose_designs
from fpcal_bayes.model.mechanics.terms import DRIFT_ORDER, Terms

#: The draws that an estimate hands on are a few hundred: more than this tell nothing new.
_MOST_DRAWS = 4000


@dataclass(frozen=True)
class MechanicsTaskErrors:
    """Draws of a task's error along its path, in um."""

    # by geometry, error motions, reversal and encoders: the same each time, shape (n_draws, n_points)
    repeatable: Floats
    returned: Floats  # by return errors: another one each time, same shape

    @property
    def total(self) -> Floats:
        """Both, shape (n_draws, n_points)."""
        return self.repeatable + self.returned


def known_task_errors(
    estimate: Estimate, start: Floats, q: Floats, *, added: Floats | None = None, draws: int = 10_000, seed: int = 0
) -> tuple[MechanicsTaskErrors, Floats, dict[str, Floats]]:
    """Draw the error along a path `q` (n_points, n_joints), driven from `start`, with what an estimate knows.

    added: what `q` adds on purpose to the change of length (see `compensated_path`), shape (n_points,).
    Returns the errors; the deviations of the parameters, (n_draws, n_parameters); and what each cause adds, by name.
    """
    drawn = _Drawn.of(estimate, draws, seed)
    rng, terms = drawn.rng(), drawn.terms
    jacobian, path = _along(estimate, terms, start, q)
    weights, moved = drawn.weights, np.flatnonzero(~drawn.drifting)
    parts = {"geometry": drawn.change @ jacobian.T}
    if len(moved) != path.motions.shape[1]:
        raise InputError("the estimate was made with other mechanics than the cell states: identify the cell anew")
    for word in dict.fromkeys(drawn.words[i] for i in moved):
        own = [k for k, i in enumerate(moved) if drawn.words[i] == word]
        parts[word] = weights[:, moved[own]] @ path.motions[:, own].T
    parts |= drawn.others(path, rng)
    if added is not None:
        parts["compensation"] = np.repeat(added[None], len(weights), axis=0)
    repeatable = np.sum(list(parts.values()), axis=0)
    returned = returned_errors(terms, path, drawn.log_scales, rng)
    made = MechanicsTaskErrors(repeatable, np.sum([np.zeros_like(repeatable), *returned.values()], axis=0))
    return made, drawn.change, parts | returned


def known_pose_errors(
    estimate: Estimate, start: Floats, q: Floats, *, draws: int = 10_000, seed: int = 0
) -> tuple[Floats, Floats]:
    """Deviations of parameters and mirror poses (n_draws, n_points, 5); weights that no length feels are as stated."""
    drawn, total = _Drawn.of(estimate, draws, seed), []
    paths = pose_designs(drawn.terms, estimate.vector(), start, q)
    weights = drawn.weights[:, ~drawn.drifting] + drawn.unfelt(paths[0].scale)
    for path in paths:
        rng = drawn.rng()
        parts = drawn.others(path, rng) | returned_errors(drawn.terms, path, drawn.log_scales, rng)
        total.append(np.sum([weights @ path.motions.T, *parts.values()], axis=0))
    return drawn.change, np.stack(total, axis=-1)


def _along(estimate: Estimate, terms: Terms, start: Floats, q: Floats) -> tuple[Floats, PathDesign]:
    """Derivatives of L along a path by the parameters (n_points, n_parameters), and by the weights."""
    model = CavityModel.of(estimate.cell, estimate.parameters)
    rows = model.rows(np.repeat(start[None], len(q), axis=0), q)
    return model.predict_with_jacobian(estimate.values, rows)[1], path_design(terms, estimate.vector(), start, q)


@dataclass(frozen=True)
class _Drawn:
    """Draws of what an estimate knows of geometry and error motions."""

    estimate: Estimate
    seed: int
    terms: Terms
    change: Floats  # deviations of the parameters, shape (n_draws, n_parameters)
    words: list[str]  # name of each weight's term
    drifting: Bools  # whether it is of the drift, shape (n_weights,)
    weights: Floats  # in units of their stated sizes, shape (n_draws, n_weights)
    log_scales: Floats  # shape (n_draws, n_scales)

    @classmethod
    def of(cls, estimate: Estimate, draws: int, seed: int) -> "_Drawn":
        knowledge = estimate.mechanics
        if knowledge is None:
            raise InputError("the estimate knows nothing of the cell's mechanics")
        draws = min(draws, _MOST_DRAWS)
        chosen = np.random.default_rng([seed, 2]).permutation(np.arange(draws) % len(knowledge.draws))
        z = knowledge.draws[chosen]
        at, slopes = knowledge.geometry(estimate.parameters.names)
        names, mean, factor = knowledge.weights(knowledge.n_parameters)
        words = [name.rpartition(" [")[0] for name in names]
        drifting = np.array([word.startswith("drift along") for word in words], dtype=bool)
        terms, log = knowledge.terms(estimate.cell), knowledge.log_scales[chosen]
        return cls(estimate, seed, terms, at + z @ slopes.T, words, drifting, mean + z @ factor.T, log)

    def rng(self) -> np.random.Generator:
        rng = np.random.default_rng([self.seed, 2])
        rng.permutation(len(self.log_scales))
        return rng

    def others(self, path: PathDesign, rng: np.random.Generator) -> dict[str, Floats]:
        """What is the same each time but no weight that a task shares: first approach, encoders, drift."""
        known = self.terms, path, self.log_scales, rng
        parts = approached(*known) | encoder_errors(*known)
        if self.drifting.any():
            assert self.estimate.mechanics is not None
            session_min = self.estimate.mechanics.session_min
            parts["drift"] = drifted(self.terms, path, self.weights[:, self.drifting], session_min, rng)
        return parts

    def unfelt(self, scale: Ints) -> Floats:
        """Draws of the weights, of these scales, across what the estimate tells of them, (n_draws, n_weights)."""
        knowledge = self.estimate.mechanics
        assert knowledge is not None
        _, _, factor = knowledge.weights(knowledge.n_parameters)
        sizes = np.exp(self.log_scales[:, scale])
        told = linalg.orth(factor[~self.drifting] / np.sqrt((sizes**2).mean(axis=0))[:, None])
        free = np.random.default_rng([self.seed, 3]).standard_normal(sizes.shape)
        return sizes * (free - free @ told @ told.T)


def known_task_sd(estimate: Estimate, start: Floats, q: Floats, added: Floats | None = None) -> Floats:
    """Root mean square of the error along a path, shape (n_points,), in um, in closed form; as `known_task_errors`."""
    knowledge = estimate.mechanics
    if knowledge is None:
        raise InputError("the estimate knows nothing of the cell's mechanics")
    terms, names = knowledge.terms(estimate.cell), estimate.parameters.names
    jacobian, path = _along(estimate, terms, start, q)
    scale = dict(zip(terms.scales, np.exp(2.0 * knowledge.log_scales).mean(axis=0).tolist(), strict=True))

    words, mean, factor = knowledge.weights(knowledge.n_parameters)
    drifting = np.array([word.startswith("drift along") for word in words], dtype=bool)
    at, slopes = knowledge.geometry(names)
    known = at @ jacobian.T + mean[~drifting] @ path.motions.T + (0.0 if added is None else added)
    drawn = known + knowledge.draws @ (jacobian @ slopes + path.motions @ factor[~drifting]).T
    square = (drawn**2).mean(axis=0) + scale["approach"] * (path.unknown_side**2).sum(axis=1)
    square += scale["encoder"] * _parted(path.places[1:] == path.places[0], path.encoded[1:], path.encoded[:1])
    square += scale["return"] * _parted(path.steps == 0, path.returned_point, path.returned_start)
    if drifting.any():
        weights = (mean[drifting] + knowledge.draws @ factor[drifting].T).reshape(-1, DRIFT_ORDER, 3)
        # Mean squares of Legendre's polynomials over the session.
        sizes = drift_sd(terms, knowledge.session_min) / np.sqrt(2.0 * np.arange(1, DRIFT_ORDER + 1) + 1.0)
        square += ((weights @ path.drift.T * sizes[:, None]) ** 2).mean(axis=0).sum(axis=0)
    return np.asarray(np.sqrt(square))


def _parted(same: Bools, point: Floats, start: Floats) -> Floats:
    """Variance at each point of normal errors that count against the start's, the same one or one of their own."""
    return np.asarray(np.where(same, (point - start) ** 2, point**2 + start**2).sum(axis=1))


def approached(terms: Terms, path: PathDesign, log_scales: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Reversal before a joint's first move, from an unknown side, by joint."""
    if not path.unknown_side.any():
        return {}
    approach = np.exp(log_scales[:, terms.scales.index("approach")])
    signs = approach[:, None] * rng.choice([-1.0, 1.0], (len(log_scales), path.unknown_side.shape[1]))
    return {
        f"first approach of q{i + 1}": signs[:, [i]] * path.unknown_side[:, i]
        for i in np.flatnonzero(path.unknown_side.any(axis=0)).tolist()
    }


def encoder_errors(terms: Terms, path: PathDesign, log_scales: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Errors of encoders of unknown period, the same whenever a joint is at the same position, by joint."""
    factor, found = np.exp(log_scales[:, terms.scales.index("encoder")])[:, None], {}
    for joint in np.flatnonzero(path.encoded.any(axis=0)).tolist():
        places = path.places[:, joint]
        normal = rng.standard_normal((len(log_scales), int(places.max()) + 1))
        drawn = factor * normal[:, places] * path.encoded[:, joint]
        found[f"encoder of q{joint + 1}"] = drawn[:, 1:] - drawn[:, :1]
    return found


def drifted(terms: Terms, path: PathDesign, weights: Floats, session_min: float, rng: np.random.Generator) -> Floats:
    """Where the fibre had drifted to at some time of the session."""
    if not weights.shape[1]:
        return np.zeros((len(weights), len(path.drift)))
    sd, when = drift_sd(terms, session_min), rng.uniform(-1.0, 1.0, len(weights))
    values = np.column_stack([when, 1.5 * when**2 - 0.5])[:, :DRIFT_ORDER]
    by_order = weights.reshape(len(weights), DRIFT_ORDER, 3)
    return np.asarray((by_order * (values * sd)[:, :, None]).sum(axis=1) @ path.drift.T)


def returned_errors(terms: Terms, path: PathDesign, log_scales: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Return errors of the joints, another one at each position that is reached, by joint."""
    factor = np.exp(log_scales[:, terms.scales.index("return")])[:, None]
    found = {}
    for joint in np.flatnonzero(path.returned_point.any(axis=0)).tolist():
        reached = rng.standard_normal((len(log_scales), int(path.steps[:, joint].max(initial=0)) + 1))
        at_points = factor * (reached[:, path.steps[:, joint]] * path.returned_point[:, joint])
        found[f"return of q{joint + 1}"] = at_points - factor * reached[:, :1] * path.returned_start[:, joint]
    return found
