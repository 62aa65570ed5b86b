"""Sample the posterior of an identification with emcee, until it has converged."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import content_sha256
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.core.version import __version__
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.posterior.checkpoint import Block, BlockStore, random_from_numbers, random_to_numbers
from fpcal_bayes.infer.posterior.diagnostics import LEAST_LENGTH, Diagnostics, diagnose
from fpcal_bayes.infer.posterior.draws import Likelihood, Posterior, make_target
from fpcal_bayes.infer.posterior.machine import MachineCharts, MachineLocalMove, MachineMove, MachineTarget
from fpcal_bayes.infer.posterior.moves import LocalMove, RandomiseThenOptimiseMove
from fpcal_bayes.infer.posterior.proposal import ProposalMixture, learn_proposals
from fpcal_bayes.infer.posterior.target import PosteriorTarget

N_ENSEMBLES = 4
N_WALKERS = 32
BLOCK_STEPS = 10
#: Share of steps that are local ones, which reach what no chart does.
LOCAL_SHARE = 0.05
#: Start: draws of the atlas with normal numbers this much too wide.
_OVER_DISPERSION = 1.5
#: Blocks left out at the beginning; the diagnostics would show if they were too few.
_WARM_UP_BLOCKS = 1
#: Each look at the diagnostics comes when those before promise convergence, between so many times the last's steps.
_LEAST_GROWTH, _MOST_GROWTH = 1.1, 3.0
#: A promise is taken with this much in hand.
_IN_HAND = 1.05

#: Repeats of the rows that they are compared with, at most.
_REPEATS = 4000
#: With mechanics every set of scales has a chart of rows by rows.
MOST_ROWS = 1000

Progress = Callable[[float, float], None]


def sample(
    identification: Identification,
    *,
    draws: int = 10_000,
    likelihood: Likelihood = "gaussian",
    scales_held: bool = False,
    seed: int = 0,
    store: BlockStore | None = None,
    max_steps: int | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior until it has converged or a limit is reached, which its `failures` say.

    Parameters
    ----------
    identification
        Converged; its minima are the reference points of the charts.
    draws
        Effective draws wanted of every parameter, in the bulk and in the tails.
    likelihood
        ``gaussian``; ``student``: outliers of any size have bounded pull; ``slip``: each dL may be off by whole half
        wavelengths.
    scales_held
        Whether the scales of the mechanics are held at their typical values instead of being sampled.
    seed
        The same seed gives the same draws.
    store
        Where blocks are kept; those already there are taken up.
    max_steps
        Limit of steps a walker; by default 5,000, or twenty times what independent draws would need.
    progress
        Called with the effective draws so far and the share of the work that is done.
    """
    children = np.random.SeedSequence(seed).spawn(N_ENSEMBLES + 1)
    target: PosteriorTarget
    runs: Sequence[_Ensemble]
    if identification.machine is not None and not scales_held:
        _require_dense(identification, likelihood)
        target = MachineTarget(identification.machine)
        charts = MachineCharts(identification.machine, children[-1])
        n_charts = len(charts.references)
        runs = [_MachineEnsemble(target, charts, child) for child in children[:N_ENSEMBLES]]
    else:
        target, references = make_target(identification, likelihood)
        if target.dof is None:
            references = learn_proposals(target, references, np.random.default_rng(children[-1]))
        # Student-t rows leave rare proposals in every tail: a further chart costs more than it helps.
        atlas = ProposalMixture(target, references)
        n_charts = len(atlas.charts)
        runs = [_Ensemble(target, atlas, child) for child in children[:N_ENSEMBLES]]
    least = -(-draws // (N_ENSEMBLES * N_WALKERS))
    limit = max(5000, 20 * least) if max_steps is None else max_steps

    blocks = [] if store is None else store.read()
    for number, run in enumerate(runs):
        if blocks:
            run.take_up(blocks[-1], number)
    next_look = min(max(BLOCK_STEPS * (_WARM_UP_BLOCKS + 5), least), limit)
    while True:
        while len(blocks) * BLOCK_STEPS < next_look:
            block = _next_block(target, runs)
            if store is not None:
                store.append(len(blocks), block)
            blocks.append(block)
            if progress is not None:
                progress(0.0, len(blocks) * BLOCK_STEPS / limit)
        done = -(-next_look // BLOCK_STEPS)
        # Blocks beyond this look, from a run that was asked for more, are not looked at: resuming changes nothing.
        posterior = _gather(identification, n_charts, target, blocks[:done], draws)
        if progress is not None:
            progress(posterior.diagnostics.effective, min(1.0, posterior.diagnostics.effective / draws))
        if posterior.converged or done * BLOCK_STEPS >= limit:
            if likelihood == "gaussian":
                return posterior
            points = posterior.points.reshape(-1, target.n_unknowns)
            points = points[:: -(-len(points) // _REPEATS)]
            return replace(posterior, predictive_p=target.predictive_p(points, np.random.default_rng([seed, 3])))
        next_look = min(_next_look(done * BLOCK_STEPS, posterior.diagnostics, draws), limit)


def _next_look(steps: int, diagnostics: Diagnostics, draws: int) -> int:
    missing = max(draws / diagnostics.effective, LEAST_LENGTH * diagnostics.autocorrelation_time / diagnostics.length)
    growth = np.clip(_IN_HAND * missing, _LEAST_GROWTH, _MOST_GROWTH)
    return int(np.ceil(steps * np.nan_to_num(growth, nan=_MOST_GROWTH)))


def identity(problem: Problem, seed: int, likelihood: Likelihood = "gaussian") -> str:
    """Hash of everything that the draws depend on: data, cell with priors, held values, seed, settings."""
    model, prior, sweeps, considered = problem.model, problem.prior, problem.sweeps, problem.considered
    numbers: list[NDArray[Any] | None] = [
        prior.mean,
        prior.sd,
        prior.factor,
        model.held,
        None if considered is None else considered.factor,
    ]
    numbers += [sweeps.q_start, sweeps.q_end, problem.target, sweeps.sigma, sweeps.signed, sweeps.group, sweeps.kind]
    sizes = model.cell.mechanics
    return content_sha256(
        {
            "program": __version__,
            "cell": [model.cell.sha256, "" if sizes is None else sizes.sha256, *model.free.names],
            "numbers": [hashlib.sha256(b"" if each is None else each.tobytes()).hexdigest() for each in numbers],
            "sampler": [likelihood, seed, N_ENSEMBLES, N_WALKERS, BLOCK_STEPS, LOCAL_SHARE],
        }
    )


class _Ensemble:
    def __init__(self, target: PosteriorTarget, proposals: Any, seed: np.random.SeedSequence) -> None:
        self.target, self.proposals = target, proposals
        self._from_charts, local = self._moves()
        self.sampler = emcee.EnsembleSampler(
            N_WALKERS,
            target.n_unknowns,
            self._log_probability,
            moves=[(self._from_charts, 1.0 - LOCAL_SHARE), (local, LOCAL_SHARE)],
            vectorize=True,
        )
        self.random = np.random.RandomState(np.random.MT19937(seed))
        self.state: emcee.State | None = None

    def run(self, n_steps: int) -> None:
        """Run some steps; the sampler holds these steps only."""
        if self.state is None:
            self.state = self._start()
        self.sampler.reset()
        # Each block starts without proposals made ahead, as it does after a kill.
        self._from_charts.forget()
        self.state = self.sampler.run_mcmc(self.state, n_steps, skip_initial_state_check=True)

    def take_up(self, block: Block, number: int) -> None:
        """Stand where the block of ensemble `number` ended."""
        self.state = emcee.State(
            block.points[number, -1],
            log_prob=block.log_density[number, -1],
            blobs=block.log_proposal[number, -1],
            random_state=random_from_numbers(block.random[number]),
        )

    def _start(self) -> emcee.State:
        found: list[Floats] = []
        while sum(map(len, found)) < N_WALKERS:
            points, log_proposal = self._spread()
            found.append(points[np.isfinite(log_proposal)])
        return emcee.State(np.concatenate(found)[:N_WALKERS], random_state=self.random.get_state())

    def _moves(self) -> tuple[Any, Any]:
        return RandomiseThenOptimiseMove(self.proposals, ahead=BLOCK_STEPS), LocalMove(self.target, self.proposals)

    def _spread(self) -> tuple[Floats, Floats]:
        """Points wider apart than the posterior, and their log proposal densities, minus infinity where none is."""
        normal = _OVER_DISPERSION * self.random.standard_normal((N_WALKERS, self.target.n_unknowns))
        solved = self.proposals.propose(normal, self.random.random_sample(N_WALKERS))
        return solved.points, solved.log_proposal

    def _log_probability(self, points: Floats) -> Floats:
        density = self.target.log_density(self.target.data_residuals(points), points)
        return np.column_stack([density, self.proposals.log_proposal(points)])


class _MachineEnsemble(_Ensemble):
    def _moves(self) -> tuple[Any, Any]:
        return MachineMove(self.proposals), MachineLocalMove(self.proposals)

    def _spread(self) -> tuple[Floats, Floats]:
        scales = self.proposals.fit.scales.log
        drawn = scales[self.random.randint(len(scales), size=N_WALKERS)]
        points, _, log_proposal = self.proposals.propose(drawn, self.random, widen=_OVER_DISPERSION)
        return points, log_proposal

    def _log_probability(self, points: Floats) -> Floats:
        return np.column_stack([self.proposals.log_density(points), self.proposals.log_proposal(points)])


def _require_dense(identification: Identification, likelihood: Likelihood) -> None:
    file, rows = identification.problem.sweeps.file, len(identification.problem.target)
    if likelihood != "gaussian":
        raise InputError(f"{file}: --likelihood {likelihood} needs --mechanics none: with mechanics rows are Gaussian")
    if rows > MOST_ROWS:
        raise InputError(f"{file}: {rows} rows, with mechanics at most {MOST_ROWS} are sampled; use --mechanics none")


def _next_block(target: PosteriorTarget, runs: Sequence[_Ensemble]) -> Block:
    began, evaluations = time.perf_counter(), target.evaluations
    for run in runs:
        run.run(BLOCK_STEPS)
    return Block(
        points=np.array([run.sampler.get_chain() for run in runs]),
        log_density=np.array([run.sampler.get_log_prob() for run in runs]),
        log_proposal=np.array([run.sampler.get_blobs() for run in runs], dtype=float),
        accepted=np.array([run.sampler.acceptance_fraction.mean() for run in runs]),
        random=np.array([random_to_numbers(run.sampler._random) for run in runs]),
        evaluations=target.evaluations - evaluations,
        seconds=time.perf_counter() - began,
    )


def _gather(
    identification: Identification, n_charts: int, target: PosteriorTarget, blocks: list[Block], draws: int
) -> Posterior:
    kept = blocks[_WARM_UP_BLOCKS:]
    points = np.concatenate([block.points for block in kept], axis=1)
    proposals = np.concatenate([block.log_proposal for block in kept], axis=1)
    # Held parameters are not judged; what stands behind them belongs to the likelihood and is.
    judged = np.r_[identification.own, identification.problem.n_unknowns : target.n_unknowns]
    if isinstance(target, MachineTarget):
        # Scales mix more slowly than the geometry, which hardly depends on each of them.
        judged = identification.own
    diagnostics = diagnose(points[..., judged])
    return Posterior(
        identification=identification,
        target=target,
        points=points,
        log_density=np.concatenate([block.log_density for block in kept], axis=1),
        charts=n_charts,
        outside=float(np.isneginf(proposals).mean()),
        diagnostics=diagnostics,
        failures=tuple(diagnostics.failures(draws)),
        acceptance=float(np.mean([block.accepted for block in blocks])),
        evaluations=sum(block.evaluations for block in blocks),
        seconds=sum(block.seconds for block in blocks),
    )
