"""Effective draws a second from case A's posterior: this program, NUTS, and emcee's own moves; one core.

The model is written once more in JAX for NUTS, and held to the program's own density before it is timed. Warm-up is
counted on all sides, compilation on none. Processor seconds, so that what else runs counts little. Run it as a program.
"""

import os

# These are read when the libraries are imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import blackjax
import emcee
import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from jax_model import changes_in_jax
from rich.console import Console
from scipy import linalg

from fpcal_bayes.infer import Identification, PosteriorTarget, identify, sample
from fpcal_bayes.io import load_cell, read_sweeps
from fpcal_bayes.report import plain_table

SWEEPS = Path(__file__).parent.parent / "tests" / "data" / "case_a.csv"
#: Effective draws a second, and how many times those of NUTS.
TARGETS = (2000.0, 500.0)


@dataclass(frozen=True)
class Run:
    """What one sampler did; draws are (n_chains, n_draws, n), groups say which chains belong to one ensemble."""

    name: str
    draws: np.ndarray
    groups: np.ndarray
    seconds: float
    evaluations: int

    @property
    def ess(self) -> float:
        """Smallest bulk effective size."""
        return float(np.min(array_stats.ess(self.draws, method="bulk", chain_axis=0, draw_axis=1)))

    @property
    def rhat(self) -> float:
        """Largest nested R-hat."""
        return float(np.max(array_stats.rhat_nested(self.draws, self.groups, chain_axis=0, draw_axis=1)))


def log_density_in_jax(found: Identification) -> Callable[[jax.Array], jax.Array]:
    """The same log density of scaled unknowns, from the equations of the model; rows are independent."""
    changes = changes_in_jax(found)
    target, scale = jnp.asarray(found.problem.target), jnp.asarray(found.problem.whitening.scale)

    def log_density(unknowns: jax.Array) -> jax.Array:
        residuals = (changes(unknowns) - target) * scale
        return -0.5 * (residuals @ residuals + unknowns @ unknowns)

    return log_density


def run_ours(found: Identification, draws: int) -> Run:
    """This program, its diagnostics included in the time."""
    sample(found, draws=1, seed=1, max_steps=60)
    began = time.process_time()
    posterior = sample(found, draws=draws, seed=0)
    seconds = time.process_time() - began
    if not posterior.converged:
        raise RuntimeError("; ".join(posterior.failures))
    n = posterior.points.shape[-1]
    chains = posterior.points.transpose(0, 2, 1, 3).reshape(128, -1, n)
    return Run("fpcal_bayes", chains, np.repeat(np.arange(4), 32), seconds, posterior.evaluations)


def run_nuts(found: Identification, draws: int, warm_up: int) -> Run:
    """NUTS of blackjax on unknowns whitened by the Laplace covariance, with a dense mass matrix; one chain."""
    problem, solution = found.problem, found.solution.unknowns
    log_density = log_density_in_jax(found)
    triangle = linalg.qr(problem.jacobian(solution), mode="r")[0][: problem.n_unknowns]
    factor = jnp.asarray(linalg.solve_triangular(triangle, np.eye(len(solution))))
    centre = jnp.asarray(solution)

    def whitened(z: jax.Array) -> jax.Array:
        return log_density(centre + factor @ z)

    adaptation = blackjax.window_adaptation(blackjax.nuts, whitened, is_mass_matrix_diagonal=False)
    kernel = blackjax.nuts.build_kernel()

    @jax.jit
    def adapt(key: jax.Array, start: jax.Array):  # type: ignore[no-untyped-def]
        (state, parameters), info = adaptation.run(key, start, warm_up)
        return state, parameters, info.info.num_integration_steps.sum()

    @jax.jit
    def advance(key: jax.Array, state, parameters):  # type: ignore[no-untyped-def]
        def one(state, key):  # type: ignore[no-untyped-def]
            state, info = kernel(key, state, whitened, **parameters)
            return state, (state.position, info.num_integration_steps)

        return jax.lax.scan(one, state, jax.random.split(key, draws))[1]

    keys = jax.random.split(jax.random.key(0), 3)
    start = jax.random.normal(keys[0], (len(solution),))
    compiled_adapt = adapt.lower(keys[1], start).compile()
    began = time.process_time()
    state, parameters, warm_up_steps = jax.block_until_ready(compiled_adapt(keys[1], start))
    seconds = time.process_time() - began
    compiled_advance = advance.lower(keys[2], state, parameters).compile()
    began = time.process_time()
    positions, steps = jax.block_until_ready(compiled_advance(keys[2], state, parameters))
    seconds += time.process_time() - began
    points = solution + np.asarray(positions) @ np.asarray(factor).T
    # One chain, cut in four for R-hat.
    quarter = len(points) // 4
    chains = points[: 4 * quarter].reshape(4, quarter, -1)
    return Run("NUTS (blackjax)", chains, np.arange(4), seconds, int(warm_up_steps + steps.sum()))


def run_emcee(found: Identification, name: str, move: emcee.moves.Move, n_steps: int) -> Run:
    """One of emcee's own moves, from the Laplace ball; half of the steps are warm-up."""
    target, solution = PosteriorTarget(found.problem), found.solution.unknowns
    triangle = linalg.qr(found.problem.jacobian(solution), mode="r")[0][: len(solution)]

    def log_probability(points: np.ndarray) -> np.ndarray:
        return target.log_density(target.data_residuals(points), points)

    random = np.random.default_rng(0)
    began, chains = time.process_time(), []
    for seed in range(4):
        normal = random.standard_normal((84, len(solution)))
        sampler = emcee.EnsembleSampler(84, len(solution), log_probability, moves=move, vectorize=True)
        start = solution + linalg.solve_triangular(triangle, normal.T).T
        state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
        sampler.run_mcmc(state, n_steps)
        chains.append(sampler.get_chain()[n_steps // 2 :].transpose(1, 0, 2))
    seconds = time.process_time() - began
    return Run(name, np.concatenate(chains), np.repeat(np.arange(4), 84), seconds, target.evaluations)


def check_model(found: Identification) -> None:
    """Hold the model in JAX to the program's own."""
    target = PosteriorTarget(found.problem)
    random = np.random.default_rng(0)
    points = found.solution.unknowns + 1e-4 * random.standard_normal((3, found.problem.n_unknowns))
    expected = target.log_density(target.data_residuals(points), points)
    values = np.array(jax.vmap(log_density_in_jax(found))(points))
    np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-5)


def run_all(draws: int, nuts_draws: int, nuts_warm_up: int, steps: int) -> list[Run]:
    """All samplers on case A, ours first."""
    cell = load_cell(mechanics="none")
    found = identify(cell, read_sweeps(SWEEPS, cell))
    check_model(found)
    return [
        run_ours(found, draws),
        run_nuts(found, nuts_draws, nuts_warm_up),
        run_emcee(found, "emcee stretch", emcee.moves.StretchMove(), steps),
        run_emcee(found, "emcee DE", emcee.moves.DEMove(), steps),
    ]


def print_table(runs: list[Run]) -> None:
    """Effective draws a second and an evaluation."""
    columns = ["sampler", "draws", "CPU s", "min ess", "ess / s", "evaluations", "ess / 1000 ev.", "R-hat", "ours / it"]
    table = plain_table("case A, one core; an evaluation of NUTS is one with its gradient", columns)
    ours = runs[0].ess / runs[0].seconds
    for run in runs:
        speed, good = run.ess / run.seconds, run.rhat < 1.01
        table.add_row(
            run.name,
            str(run.draws.shape[0] * run.draws.shape[1]),
            f"{run.seconds:.1f}",
            f"{run.ess:.0f}" + ("" if good else " (not converged)"),
            f"{speed:.2f}",
            str(run.evaluations),
            f"{1000 * run.ess / run.evaluations:.2f}",
            f"{run.rhat:.3f}",
            f"{ours / speed:.0f}",
        )
    Console(width=140, highlight=False).print(table)


def main() -> int:
    """Print the table; exit status 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--nuts-draws", type=int, default=300)
    parser.add_argument("--nuts-warm-up", type=int, default=300)
    parser.add_argument("--steps", type=int, default=1000, help="of emcee's own moves")
    options = parser.parse_args()
    runs = run_all(options.draws, options.nuts_draws, options.nuts_warm_up, options.steps)
    print_table(runs)
    ours, nuts = (run.ess / run.seconds for run in runs[:2])
    return 0 if ours >= TARGETS[0] and ours >= TARGETS[1] * nuts and runs[0].rhat < 1.01 else 1


if __name__ == "__main__":
    raise SystemExit(main())
