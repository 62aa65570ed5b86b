"""The four studies: what a replicate gives, against exact cases, and what their summaries find."""

import pickle

import numpy as np
import pytest

from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.study import sbc as posterior_ranks
from fpcal_bayes.study.base import sweeps_sha256
from fpcal_bayes.study.coverage import METHODS, QUANTITIES, SHARES, Coverage, summarise
from fpcal_bayes.study.drifting_week import Setting, simulate_week
from fpcal_bayes.study.planning import Planning
from fpcal_bayes.study.policies import DEFAULT_POLICIES, Policies, rules
from fpcal_bayes.study.sbc import RANKED, PosteriorRanks, Replicate, quantities


def studies(cell):
    paper = paper_protocol(cell)
    return [
        Coverage(cell=cell, plan=paper),
        Planning(cell=cell, plan=paper),
        Policies(cell=cell, goal=Goal(50.0), policies=("never", "q3 and q1 every 1 h"), hours=2.0),
    ]


@pytest.mark.parametrize("which", range(3))
def test_a_replicate_depends_on_its_number_alone(femto, which):
    study = studies(femto)[which]
    first = study.replicate(2)
    assert {name: value.shape for name, value in first.items()} == study.shapes()
    # As a worker gets it, after another replicate.
    sent = pickle.loads(pickle.dumps(study))
    other = sent.replicate(1)
    again = sent.replicate(2)
    assert all(np.array_equal(first[name], again[name], equal_nan=True) for name in first)
    assert any(not np.array_equal(first[name], other[name], equal_nan=True) for name in first)
    assert sent.settings() == study.settings()
    rows = study.summary({name: np.array([first[name], other[name]]) for name in first}).rows
    assert len(rows) > 0
    assert len({tuple(row) for row in rows}) == 1


class TestCoverage:
    @staticmethod
    def results(width: float, n: int = 400) -> dict[str, np.ndarray]:
        """Truths that are normal; bands of a normal distribution that is `width` times as wide."""
        from scipy import stats

        random = np.random.default_rng(0)
        edges = stats.norm.ppf([[(1 - share) / 2, (1 + share) / 2] for share in SHARES])
        bands = np.broadcast_to(width * edges, (n, len(QUANTITIES), len(SHARES), 2))
        fit = {name: np.ones(n) for name in ("converged", "chi2_data", "sum_of_squares")}
        true = {"true": random.standard_normal((n, len(QUANTITIES))), "p_value": random.random(n)}
        return fit | true | dict.fromkeys(METHODS, bands)

    def test_right_bands_pass(self):
        summary = summarise(self.results(1.0))
        assert not summary.warnings
        for row in summary.rows:
            assert row["n"] == 400
            for share in SHARES:
                assert abs(row[f"in_{100 * share:g}_percent"] - 100 * share) < 10

    @pytest.mark.parametrize("width", [0.7, 1.4])
    def test_wrong_bands_are_found(self, width):
        assert "do not hold what they state" in summarise(self.results(width)).warnings[0]

    def test_what_did_not_converge_is_left_out(self):
        results = self.results(1.0)
        results["converged"] = np.where(np.arange(400) < 3, 0.0, 1.0)
        summary = summarise(results)
        assert summary.rows[0]["n"] == 397
        assert summary.warnings == ["3 calibrations did not converge and are left out"]


def test_a_plan_that_is_the_paper_s_is_as_good(femto):
    found = Planning(cell=femto, plan=paper_protocol(femto)).replicate(0)
    assert np.array_equal(found["plan"], found["paper"])
    assert np.isfinite(found["plan"]).sum() >= len(DEFAULT_TASKS) - 1


def test_a_truth_that_is_not_identified_has_no_ranks(femto, monkeypatch):
    study = PosteriorRanks(cell=femto, plan=paper_protocol(femto))
    for ranks, failures in ((None, ("not identified",)), (list(range(len(quantities(femto)))), ())):
        monkeypatch.setattr(posterior_ranks, "ranks_of", lambda *_, **__: Replicate(ranks, failures, 2))  # noqa: B023
        found = study.replicate(0)
        assert {name: value.shape for name, value in found.items()} == study.shapes()
        assert found["identified"] == found["sampled"] == float(ranks is not None)
        assert np.isnan(found["ranks"]).all() == (ranks is None)


def test_ranks_of_a_right_sampler(femto):
    study = PosteriorRanks(cell=femto, plan=paper_protocol(femto))
    n = len(quantities(femto))
    random = np.random.default_rng(3)
    flags = dict.fromkeys(("identified", "sampled", "charts"), np.ones(300))
    good = random.integers(0, RANKED + 1, (300, n)).astype(float)
    assert not study.summary(flags | {"ranks": good}).warnings
    narrow = np.clip(1.5 * (good - 100) + 100, 0, RANKED).round()
    assert study.summary(flags | {"ranks": narrow}).warnings[0].startswith("not calibrated")


class TestPolicies:
    def test_the_default_policies_are_known(self, femto):
        assert set(DEFAULT_POLICIES) <= set(rules(Setting(femto), Goal(50.0)))

    def test_measuring_more_often_takes_more_sweeps(self, femto):
        found = Policies(
            cell=femto, goal=Goal(50.0), policies=("never", "q3 and q1 every 1 h"), hours=3.0
        ).replicate(0)  # fmt: skip
        assert found["sweeps"].tolist() == [0.0, 4.0]
        assert found["sessions"].tolist() == [0.0, 2.0]
        assert ((found["all_in_tolerance"] >= 0) & (found["all_in_tolerance"] <= found["in_tolerance"][:, 0])).all()

    def test_the_truth_walks_as_the_drift_model_says(self, femto):
        setting = Setting(femto, hours=48.0)
        week = simulate_week(setting, 5)
        steps = np.diff(week.values, axis=0)
        drifting = setting.drift.walk > 0
        rate = (
            np.sqrt((steps[:, drifting] ** 2).sum(axis=0) / 2.0) / (setting.drift.walk * setting.drift.scale)[drifting]
        )
        # 480 steps: a standard error of 3 %.
        np.testing.assert_allclose(rate, 1.0, atol=0.13)
        assert (steps[:, ~drifting] == 0).all()


def test_sweeps_are_told_apart(femto):
    paper = paper_protocol(femto)
    assert sweeps_sha256(paper) == sweeps_sha256(paper_protocol(femto))
    assert sweeps_sha256(paper) != sweeps_sha256(paper_protocol(femto, midpoints=True))
    assert sweeps_sha256(paper) != sweeps_sha256(paper.take(np.arange(68)))
