"""The density of a posterior, and draws of it; apart from the sampler, since emcee takes half a second to import."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fpcal_bayes.core.notebook import Result
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.minimise import Solution, all_minima, minimise
from fpcal_bayes.infer.fit.slips import MOST_HALF_WAVES, Slips, find_slips
from fpcal_bayes.infer.fit.student import DOF, StudentProblem, robust_minimum
from fpcal_bayes.infer.posterior.diagnostics import Diagnostics
from fpcal_bayes.infer.posterior.noise_scale import NoiseScale, scaled_problem
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
    # of rows that may slip, have heavy tails or a noise of unknown size: how many repeats of them are less likely
    predictive_p: float | None = None

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return f"Posterior({state}, {self.log_density.size} draws of {len(self.identification.free)} parameters)"

    @property
    def converged(self) -> bool:
        """Whether the draws can be used."""
        return not self.failures

    @property
    def trust(self) -> Trust:
        """What is held against the draws.

        Second solutions and doubtful signs are sampled, and a poor fit to Gaussian noise says nothing of rows that may
        slip, have heavy tails or a noise of unknown size.
        """
        told = {"second-solution", "signs"}
        if isinstance(self.target, SlipTarget) or self.target.dof is not None or self.target.noise is not None:
            told |= {"poor-fit", "too-good-fit"}
        left = Trust(tuple(r for r in self.identification.estimate.trust.reasons if r.kind not in told))
        left = left.because(*(Reason("not-converged", f"the draws did not converge: {why}") for why in self.failures))
        return left if self.misfit is None else left.because(Reason("poor-fit", self.misfit))

    @property
    def misfit(self) -> str | None:
        """What the likelihood itself says against the rows, or None."""
        if self.predictive_p is None or self.predictive_p >= POOR_FIT_BELOW:
            return None
        kind, allowed = "scaled-noise", "noise of any size"
        if self.target.dof is not None:
            kind, allowed = "Student-t", "outliers of any size"
        if isinstance(self.target, SlipTarget):
            kind, allowed = "slip", f"slips of up to {MOST_HALF_WAVES} half waves between two readings"
        return (
            f"poor fit: of repeats that the {kind} posterior predicts {100 * self.predictive_p:.2g} % are as unlikely "
            f"as these rows; it allows for {allowed}, and something else is wrong"
        )

    def values(self) -> Floats:
        """Draws of the free parameters in um and rad, shape (n_chains, n_steps, n)."""
        n_ensembles, n_steps, n_walkers, n = self.points.shape
        chains = self.points.transpose(0, 2, 1, 3).reshape(n_ensembles * n_walkers, n_steps, n)
        return self.identification.problem.values(chains)[..., self.identification.own]


def make_target(
    identification: Identification, likelihood: Likelihood, noise_scale: bool = False
) -> tuple[PosteriorTarget, Floats]:
    """The density to sample and the reference points of its charts, shape (n_charts, n_unknowns)."""
    problem, signs = identification.problem, identification.signs
    minima: Sequence[Solution] = (identification.solution, *identification.other_minima)
    slips: Slips | None = None
    if likelihood == "slip":
        slips = find_slips(problem, identification.solution)
        problem, minima = slips.problem, all_minima(slips.problem, slips.solution)
    elif likelihood == "student":
        problem = StudentProblem.like(problem, DOF)
        minima = all_minima(problem, robust_minimum(problem, identification.solution.unknowns))
    noise = None
    if noise_scale:
        noise = NoiseScale.of(problem, minima[0])
        minima = [minimise(scaled_problem(problem, noise.reference), minimum.unknowns) for minimum in minima]
    if signs is not None:
        # Other signs that fit nearly as well: a chart at the minimum of each.
        minima = [*minima, *signs.rivals]
    references = np.array([minimum.unknowns for minimum in minima])
    if noise is not None:
        references = np.column_stack([references, np.full(len(references), noise.reference)])
    if slips is not None:
        slip_target = SlipTarget(slips, noise=noise)
        return slip_target, np.column_stack([references, np.full(len(references), slip_target.reference)])
    target = PosteriorTarget(
        identification.problem,
        dof=DOF if likelihood == "student" else None,
        noise=noise,
        doubt=None if signs is None else signs.doubt,
    )
    return target, references


def independent_draws(found: Identification, draws: int = N_DRAWS, seed: int = 0) -> Floats:
    """Draws of the posterior around all of its minima, shape (draws, n_free), in um and rad.

    The minima are the reference points of the charts. Points that the charts propose too rarely stand in it more than
    once. None, shape (0, n_free), where the charts do not tell enough of the posterior, as of a poor fit.
    """
    target, references = make_target(found, "gaussian")
    atlas, random = ProposalMixture(target, references), np.random.default_rng(seed)
    points, log_weights = np.zeros((0, target.n_unknowns)), np.zeros(0)
    for _ in range(_MOST_ROUNDS):
        solved = atlas.propose(random.standard_normal((draws, target.n_unknowns)), random.random(draws))
        points = np.vstack([points, solved.points[solved.inside]])
        fresh = solved.log_density[solved.inside] - solved.log_proposal[solved.inside]
        log_weights = np.concatenate([log_weights, fresh])
        weights = np.exp(log_weights - log_weights.max()) if len(log_weights) else np.zeros(1)
        worth = float(weights.sum() ** 2 / max(float((weights**2).sum()), 1e-300))
        if worth >= _LEAST_WORTH * draws:
            break
    else:
        return np.zeros((0, len(found.free)))
    # Systematic resampling: each point as often as its weight says, up to rounding.
    places = (np.arange(draws) + random.random()) / draws
    chosen = np.searchsorted(np.cumsum(weights) / weights.sum(), places)
    return found.problem.values(points[np.minimum(chosen, len(points) - 1)])[:, found.own]


def draws_content(found: Identification, draws: int = N_DRAWS) -> dict[str, Any]:
    """Draws as JSON, in um and deg: names and one row a draw; empty where the covariance has to do.

    That is so if the fit did not converge or is so poor that the charts fail, or parameters are held: draws would let
    the data speak about these; or if the draws stand with those of the mechanics.
    """
    free = found.free
    if not found.converged or found.machine is not None or free.names != found.estimate.parameters.names:
        return {}
    values = independent_draws(found, draws)
    if not len(values):
        return {"draws": None, "warnings": [*found.warnings, LOST]}
    shown = np.round(free.to_shown(values), _DIGITS)
    return {"draws": {"names": list(free.names), "rows": shown.tolist()}}
