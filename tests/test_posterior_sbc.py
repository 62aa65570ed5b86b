import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fpcal_bayes.study.sbc import TASK


@pytest.fixture(scope="module")
def sbc() -> ModuleType:
    path = Path(__file__).parents[1] / "studies" / "posterior_sbc.py"
    spec = importlib.util.spec_from_file_location("posterior_sbc", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class TestJudge:
    """The study's own tests find what they are for, and only that."""

    @staticmethod
    def p_value(sbc: ModuleType, ranks: np.ndarray) -> float:
        return sbc.least_p(sbc.judge("name", ranks, np.random.default_rng(0)))

    def test_uniform_ranks_pass(self, sbc):
        random = np.random.default_rng(1)
        p_values = [self.p_value(sbc, random.integers(0, sbc.RANKED + 1, 500)) for _ in range(400)]
        # Of 400 corrected p-values, 4 are expected below 0.01.
        assert np.sum(np.array(p_values) < 0.01) <= 12
        assert np.mean(np.array(p_values) < 0.5) < 0.55

    @pytest.mark.parametrize(("mean", "sd"), [(0.0, 1.25), (0.0, 0.8), (0.35, 1.0)])
    def test_draws_too_narrow_too_wide_or_aside_fail(self, sbc, mean, sd):
        random = np.random.default_rng(2)
        truths, draws = sd * random.standard_normal(500) + mean, random.standard_normal((500, sbc.RANKED))
        assert self.p_value(sbc, (draws < truths[:, None]).sum(axis=1)) < 1e-4

    def test_intervals_hold_their_share_of_ranks(self, sbc):
        verdict = sbc.judge("name", np.arange(sbc.RANKED + 1), np.random.default_rng(0))
        assert verdict.covered == list(sbc.COVERAGES)


class TestPlans:
    def test_no_sweep_makes_the_task_move(self, sbc, femto):
        for protocol in sbc.PROTOCOLS:
            plan = sbc.plan(protocol, femto)
            assert ((plan.q_start != plan.q_end).sum(axis=1) == 1).all()
        assert (TASK[0] != TASK[1]).all()


@pytest.mark.slow
def test_replicates_do_not_depend_on_the_number_of_processes(sbc):
    settings = {"protocol": "random", "seed": 3, "draws": 50, "steps": 20}
    alone = sbc.run_replicate(1, **settings)
    assert sbc.run_protocol("random", range(1, 2), 3, 50, 1, 20) == [alone]
    assert alone != sbc.run_replicate(2, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["paper", "random"])
def test_calibrated(sbc, femto, protocol):
    """50 truths a protocol; family-wise over all quantities and both protocols. The study runs more, to convergence."""
    names = sbc.quantities(femto)
    found = sbc.run_protocol(protocol, range(50), seed=1, draws=400, processes=1, steps=20)
    assert all(replicate.ranks is not None for replicate in found)
    ranks = np.array([replicate.ranks for replicate in found])
    random = np.random.default_rng(0)
    worst = {name: sbc.least_p(sbc.judge(name, ranks[:, i], random)) for i, name in enumerate(names)}
    key = min(worst, key=worst.__getitem__)
    assert 2 * len(worst) * worst[key] > sbc.FAMILY_WISE, key
