"""The density of a posterior, and draws of it; apart from the sampler, since emcee takes half a second to import."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, Literal

import numpy as np
from scipy import special

from fpcal_bayes.core.notebook import Result
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.minimise import Solution, all_minima
from fpcal_bayes.infer.fit.slips import MOST_HALF_WAVES, find_slips
from fpcal_bayes.infer.fit.student import DOF, StudentProblem, robust_minimum
from fpcal_bayes.infer.posterior.diagnostics import Diagnostics
from fpcal_bayes.infer.posterior.proposal import ProposalMixture
from fpcal_bayes.infer.posterior.target import PosteriorTarget
from fpcal_bayes.infer.posterior.target_slip import SlipTarget
from fpcal_bayes.model.trust import POOR_FIT_BELOW, Reason, Trust

Likelihood = Literal["gaussian", "student", "slip"]

#: Draws that an estimate hands on beside its covariance.
N_DRAWS = 500
#: Further draws are made until they are worth this share of those wanted, at most so many times.
_LEAST_WORTH = 0.5
_MOST_ROUNDS = 8
#: The same of draws to which nothing else gives more, and the shape of their weights' tail that is allowed.
_MOST_CHARTED = 24
MOST_K = 0.7
LOST = "no posterior draws travel with the estimate, too few could be made of this fit: bands are of first order"
#: Digits kept after the point, in um and deg: a hundredth of a picometre on a task.
_DIGITS = 10


@dataclass(frozen=True)
class Posterior(Result):
    """Draws of a posterior."""

    identification: Identification  # where the charts come from
    target: PosteriorTarget  # the density that was sampled
    points: Floats  # scaled unknowns, shape (n_ensembles, n_steps, n_walkers, n_unknowns), without the warm-up
    log_density: Floats  # unnormalised, shape (n_ensembles, n_steps, n_walkers)
    charts: int  # number of charts that proposals came from
    outside: float  # share of the draws that lie outside every chart, where only the local move leads
    diagnostics: Diagnostics  # of the free parameters' draws
    failures: tuple[str, ...]  # what is not converged; empty if the draws can be used
    acceptance: float  # share of all moves
    evaluations: int  # points at which the density was evaluated
    seconds: float  # sampling time
    predictive_p: float | None = None  # where rows may slip or have heavy tails: share of less likely repeats

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return f"Posterior({state}, {self.log_density.size} draws of {len(self.identification.free)} parameters)"

    @property
    def converged(self) -> bool:
        """Whether the draws can be used."""
        return not self.failures

    @property
    def trust(self) -> Trust:
        """What is held against the draws; second solutions and signs are sampled, rows may slip or have heavy tails."""
        told = {"second-solution", "signs"}
        if isinstance(self.target, SlipTarget) or self.target.dof is not None:
            told |= {"poor-fit", "too-good-fit", "slips"}
        left = Trust(tuple(r for r in self.identification.estimate.trust.reasons if r.kind not in told))
        left = left.because(*(Reason("not-converged", f"the draws did not converge: {why}") for why in self.failures))
        return left if self.misfit is None else left.because(Reason("poor-fit", self.misfit))

    @property
    def misfit(self) -> str | None:
        """What the likelihood itself says against the rows, or None."""
        return misfit_of(self.target, self.predictive_p)

    def values(self) -> Floats:
        """Draws of the free parameters in um and rad, shape (n_chains, n_steps, n)."""
        n_ensembles, n_steps, n_walkers, n = self.points.shape
        chains = self.points.transpose(0, 2, 1, 3).reshape(n_ensembles * n_walkers, n_steps, n)
        return self.identification.problem.values(chains)[..., self.identification.own]


def misfit_of(target: PosteriorTarget, predictive_p: float | None) -> str | None:
    """What a likelihood itself says against the rows, given how many repeats of them are less likely, or None."""
    if predictive_p is None or predictive_p >= POOR_FIT_BELOW:
        return None
    kind, allowed = "Student-t", "outliers of any size"
    if isinstance(target, SlipTarget):
        kind, allowed = "slip", f"slips of up to {MOST_HALF_WAVES} half waves between two readings"
    return (
        f"poor fit: of repeats that the {kind} posterior predicts {100 * predictive_p:.2g} % are as unlikely "
        f"as these rows; it allows for {allowed}, and something else is wrong"
    )


def make_target(identification: Identification, likelihood: Likelihood) -> tuple[PosteriorTarget, Floats]:
    """The density to sample and the reference points of its charts, shape (n_charts, n_unknowns)."""
    problem, signs = identification.problem, identification.signs
    minima: Sequence[Solution] = (identification.solution, *identification.other_minima)
    if likelihood == "slip":
        slips = find_slips(problem, identification.solution)
        target = SlipTarget(slips)
        minima = all_minima(slips.problem, slips.solution)
        # Rows that may slip have a known sign.
        eps = np.full(len(minima), target.reference)
        return target, np.column_stack([np.array([minimum.unknowns for minimum in minima]), eps])
    if likelihood == "student":
        bent = StudentProblem.like(problem, DOF)
        minima = all_minima(bent, robust_minimum(bent, identification.solution.unknowns))
    if signs is not None:
        # Other signs that fit nearly as well: a chart at the minimum of each.
        minima = [*minima, *signs.rivals]
    dof, doubt = DOF if likelihood == "student" else None, None if signs is None else signs.doubt
    return PosteriorTarget(problem, dof=dof, doubt=doubt), np.array([minimum.unknowns for minimum in minima])


@dataclass(frozen=True)
class WeightedDraws:
    """Draws of a posterior that count by their weights."""

    target: PosteriorTarget  # the density that they are of
    points: Floats  # scaled unknowns, shape (n_points, n_unknowns)
    log_weights: Floats  # unnormalised, shape (n_points,)
    independent: float = 1.0  # share of them that is worth independent draws

    @cached_property
    def worth(self) -> float:
        """How many equal draws they are worth (Kish)."""
        return 1.0 / float((special.softmax(self.log_weights) ** 2).sum()) if len(self.log_weights) else 0.0

    def equal(self, count: int, random: np.random.Generator) -> Floats:
        """Points of equal weight, shape (count, n_unknowns), by systematic resampling."""
        places = (np.arange(count) + random.random()) / count
        chosen = np.searchsorted(np.cumsum(special.softmax(self.log_weights)), places)
        return self.points[np.minimum(chosen, len(self.points) - 1)]


def smoothed_weights(log_weights: Floats, independent: float = 1.0) -> tuple[Floats, float]:
    """Log weights that add up to one, their tail smoothed, and its shape k; infinite where one outweighs all others."""
    # Importing arviz takes long: only where it is used.
    from arviz_stats.base import array_stats

    try:
        # The smoother takes log likelihoods, whose negative are the log weights; those of one draw that outweighs all
        # others underflow, and k is then no number.
        with np.errstate(all="ignore"):
            smoothed, k = array_stats.psislw(-log_weights, independent)
    except ValueError:
        return special.log_softmax(log_weights), np.inf
    return special.log_softmax(smoothed), float(np.nan_to_num(k, nan=np.inf, posinf=np.inf))


def growing_draws(
    found: Identification, likelihood: Likelihood, batch: int, random: np.random.Generator
) -> Iterator[WeightedDraws]:
    """Independent draws that charts around the minima propose, weighted by the posterior: more of them each time."""
    target, references = make_target(found, likelihood)
    atlas, n = ProposalMixture(target, references), target.n_unknowns
    points, log_weights = np.zeros((0, n)), np.zeros(0)
    while True:
        solved = atlas.propose(random.standard_normal((batch, n)), random.random(batch))
        fresh = solved.log_density[solved.inside] - solved.log_proposal[solved.inside]
        points, log_weights = np.vstack([points, solved.points[solved.inside]]), np.r_[log_weights, fresh]
        yield WeightedDraws(target, points, log_weights)


def charted_draws(
    found: Identification, likelihood: Likelihood, draws: int, random: np.random.Generator
) -> WeightedDraws | None:
    """Weighted draws that are worth `draws` equal ones; None where the charts do not tell enough."""
    for k, known in enumerate(islice(growing_draws(found, likelihood, 2 * draws, random), _MOST_CHARTED), 1):
        if known.worth >= draws and smoothed_weights(known.log_weights)[1] <= MOST_K:
            return known
        if known.worth < _LEAST_WORTH * draws * k / _MOST_CHARTED:
            break
    return None


def independent_draws(found: Identification, draws: int = N_DRAWS, seed: int = 0) -> Floats:
    """Draws of the posterior, (draws, n_free), in um and rad; none, (0, n_free), where charts tell too little."""
    random = np.random.default_rng(seed)
    for known in islice(growing_draws(found, "gaussian", draws, random), _MOST_ROUNDS):
        if known.worth >= _LEAST_WORTH * draws:
            return found.problem.values(known.equal(draws, random))[:, found.own]
    return np.zeros((0, len(found.free)))


def draws_content(found: Identification, draws: int = N_DRAWS) -> dict[str, Any]:
    """Draws as JSON, in um and deg; none without convergence, of held parameters, or with those of mechanics."""
    free = found.free
    if not found.converged or found.machine is not None or free.names != found.estimate.parameters.names:
        return {}
    values = independent_draws(found, draws)
    if not len(values):
        return {"draws": None, "warnings": [*found.warnings, LOST]}
    return {"draws": {"names": list(free.names), "rows": np.round(free.to_shown(values), _DIGITS).tolist()}}
