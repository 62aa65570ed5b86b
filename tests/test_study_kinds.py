"""The studies: what a replicate gives, against exact cases, and what their summaries find."""

import pickle

import numpy as np
import pytest

from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.study import sbc as posterior_ranks
from fpcal_bayes.study.base import sweeps_sha256
from fpcal_bayes.study.coverage import METHODS, QUANTITIES, SHARES, Coverage, summarise
from fpcal_bayes.study.sbc import RANKED, PosteriorRanks, Replicate, quantities


def test_a_replicate_depends_on_its_number_alone(femto):
    study = Coverage(cell=femto, plan=paper_protocol(femto))
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


def test_sweeps_are_told_apart(femto):
    paper = paper_protocol(femto)
    assert sweeps_sha256(paper) == sweeps_sha256(paper_protocol(femto))
    assert sweeps_sha256(paper) != sweeps_sha256(paper_protocol(femto, midpoints=True))
    assert sweeps_sha256(paper) != sweeps_sha256(paper.take(np.arange(68)))
