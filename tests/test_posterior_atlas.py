import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import special
from toy_targets import LinearTarget, TwistedTarget

from fpcal_bayes.infer.posterior.proposal import ProposalMixture, Solved

BIMODAL = {"bend": 1.0, "apart": 3.0, "tilt": 0.3}


def proposals(atlas: ProposalMixture, n: int, seed: int = 0):
    random = np.random.default_rng(seed)
    return atlas.propose(random.standard_normal((n, atlas.target.n_unknowns)), random.random(n))


@pytest.fixture(scope="module")
def atlas() -> ProposalMixture:
    target = TwistedTarget(4, **BIMODAL)
    assert len(target.references) == 2
    return ProposalMixture(target, target.references)


class TestMixture:
    def test_shares(self, atlas):
        assert atlas.shares.sum() == pytest.approx(1.0)
        assert (atlas.shares > 0).all()
        # The lowest minimum stands first; here it is the heavier one too.
        assert atlas.shares[0] > atlas.shares[1]

    def test_proposing_and_asking_give_the_same_density(self, atlas):
        solved = proposals(atlas, 400)
        asked = atlas.log_proposal(solved.points[solved.inside])
        assert_allclose(asked, solved.log_proposal[solved.inside], rtol=0, atol=1e-5)

    def test_density_is_the_sum_over_charts(self, atlas):
        points = proposals(atlas, 100).points
        parts = [
            np.log(share) + chart.log_proposal(points) for share, chart in zip(atlas.shares, atlas.charts, strict=True)
        ]
        assert_allclose(atlas.log_proposal(points), special.logsumexp(parts, axis=0))

    def test_weights_of_the_proposals_give_the_modes(self, atlas):
        """Importance weights target / proposal, averaged on each side, are the masses of the modes."""
        solved = proposals(atlas, 20_000)
        assert solved.inside.mean() > 0.9
        solved = Solved(*(part[solved.inside] for part in vars(solved).values()))
        weights = np.exp(solved.log_density - solved.log_proposal)
        right = atlas.target.straight(solved.points)[:, 0] > 0
        values, exact = atlas.target.grid
        share = weights[right].sum() / weights.sum()
        # Of a ratio of two means.
        error = np.sqrt((weights**2 * (right - share) ** 2).sum()) / weights.sum()
        assert error < 0.01
        assert abs(share - exact[values > 0].sum()) < 4 * error

    def test_no_point_is_proposed_that_the_target_excludes(self, atlas):
        solved = proposals(atlas, 1000)
        assert np.isfinite(solved.log_density[solved.inside]).all()
        assert (np.isfinite(solved.log_proposal) == solved.inside).all()


class TestSingle:
    def test_one_chart(self):
        target = LinearTarget(5)
        atlas = ProposalMixture(target, target.references)
        assert_allclose(atlas.shares, [1.0])
        solved = proposals(atlas, 64)
        assert solved.inside.all()
        assert_allclose(atlas.log_proposal(solved.points), solved.log_proposal, rtol=0, atol=1e-6)

    def test_equal_charts_are_one(self):
        target = LinearTarget(5)
        one, two = ProposalMixture(target, target.references), ProposalMixture(target, np.zeros((2, 5)))
        assert_allclose(two.shares, [0.5, 0.5])
        points = target.draw(50, np.random.default_rng(0))
        assert_allclose(two.log_proposal(points), one.log_proposal(points), rtol=0, atol=1e-9)
