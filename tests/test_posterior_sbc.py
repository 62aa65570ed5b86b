"""Ranks of truths among posterior draws: the tests of ranks find what they are for, and the sampler passes them."""

from dataclasses import dataclass

import numpy as np
import pytest

from fpcal_bayes.study.sbc import (
    COVERAGES,
    FAMILY_WISE,
    PROTOCOLS,
    RANKED,
    TASK,
    PosteriorRanks,
    judge,
    quantities,
    sbc_plan,
)


class TestJudge:
    @staticmethod
    def p_value(ranks: np.ndarray) -> float:
        return judge("name", ranks, np.random.default_rng(0))["p_corrected"]

    def test_uniform_ranks_pass(self):
        random = np.random.default_rng(1)
        p_values = [self.p_value(random.integers(0, RANKED + 1, 500)) for _ in range(400)]
        # Of 400 corrected p-values, 4 are expected below 0.01.
        assert np.sum(np.array(p_values) < 0.01) <= 12
        assert np.mean(np.array(p_values) < 0.5) < 0.55

    @pytest.mark.parametrize(("mean", "sd"), [(0.0, 1.25), (0.0, 0.8), (0.35, 1.0)])
    def test_draws_too_narrow_too_wide_or_aside_fail(self, mean, sd):
        random = np.random.default_rng(2)
        truths, draws = sd * random.standard_normal(500) + mean, random.standard_normal((500, RANKED))
        assert self.p_value((draws < truths[:, None]).sum(axis=1)) < 1e-4

    def test_intervals_hold_their_share_of_ranks(self):
        verdict = judge("name", np.arange(RANKED + 1), np.random.default_rng(0))
        assert [verdict[f"in_{100 * share:g}_percent"] for share in COVERAGES] == [100 * share for share in COVERAGES]


def test_no_sweep_makes_the_task_move(femto):
    for protocol in PROTOCOLS:
        plan = sbc_plan(protocol, femto)
        assert ((plan.q_start != plan.q_end).sum(axis=1) == 1).all()
    assert (TASK[0] != TASK[1]).all()


@dataclass(frozen=True, kw_only=True)
class Ranks(PosteriorRanks):
    """Each protocol has truths of its own: along a gauge their ranks are the same whatever is measured."""

    protocol: str

    def random(self, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, PROTOCOLS.index(self.protocol), number])


@pytest.mark.slow
@pytest.mark.usefixtures("minima_only")
def test_calibrated(femto):
    """8 truths a protocol, ranked together: what is wrong with the sampler is so under both.

    The study runs hundreds of each, to convergence, and judges them apart.
    """
    ranks = []
    for protocol in ("paper", "random"):
        study = Ranks(cell=femto, plan=sbc_plan(protocol, femto), protocol=protocol, seed=1, draws=400, steps=20)
        ranks += [study.replicate(number)["ranks"] for number in range(8)]
    found = np.array(ranks)
    assert np.isfinite(found).all()
    # A replicate depends on its number alone.
    assert (study.replicate(3)["ranks"] == found[-5]).all()
    assert len(np.unique(found, axis=0)) == len(found)

    def worst(ranks: np.ndarray) -> tuple[float, str]:
        """The smallest p of all quantities, corrected for their number."""
        names, random = quantities(femto), np.random.default_rng(0)
        judged = zip(names, ranks.T.astype(int), strict=True)
        return min((len(names) * judge(name, column, random)["p_corrected"], name) for name, column in judged)

    assert worst(found)[0] > FAMILY_WISE, worst(found)
    # Draws half as wide around the same centres would not pass, nor would draws aside.
    middle = RANKED / 2.0
    assert worst(np.clip(middle + 2.0 * (found - middle), 0, RANKED).round())[0] < FAMILY_WISE
    assert worst(np.clip(found + RANKED // 3, 0, RANKED))[0] < FAMILY_WISE
