"""Planning on one core: a plan of twelve sweeps over the prior, and a policy's choice of three at one estimate."""

import time
from typing import Any

import numpy as np

from fpcal_bayes.infer import Planner, PlanSettings, candidate_sweeps, choose_sweeps, prior_ground, sweep_rows
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import paper_protocol

CELL = load_cell(mechanics="none")
#: Processor seconds that a plan of twelve may take; it runs on one core.
MOST_SECONDS = 10.0


def test_twelve_sweeps_of_2000_candidates_over_192_draws(benchmark: Any) -> None:
    """From the prior to the plan: draws, tasks, candidates, starts and descents."""

    def plan() -> float:
        began = time.process_time()
        ground = prior_ground(CELL, draws=192, seed=1)
        reference = ground.expected_sd(paper_protocol(CELL), readings=1)
        assert len(Planner(ground, PlanSettings(), reference).best(12)) == 12
        return time.process_time() - began

    assert benchmark.pedantic(plan, rounds=1, warmup_rounds=0) < MOST_SECONDS


def test_three_of_300_candidates_at_one_estimate(benchmark: Any) -> None:
    """What the policy pays for each choice: rows of the candidates, greedy search and exchange."""
    ground = prior_ground(CELL, draws=4, seed=0).at_draws(np.array([0]))
    candidates = candidate_sweeps(CELL, n=300, rng=np.random.default_rng(0))

    def choose() -> int:
        rows = sweep_rows(ground.model, ground.goals.values, candidates)
        return len(choose_sweeps(rows, ground.goals.jacobians, 3, ground.covariance))

    assert benchmark(choose) == 3
