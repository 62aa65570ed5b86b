import numpy as np
import pytest
from numpy.testing import assert_allclose
from toy_targets import CubicTarget, LinearTarget, ToyTarget, TwistedTarget

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.proposal import Proposal
from fpcal_bayes.infer.posterior.target import PosteriorTarget
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um


@pytest.fixture(scope="module", params=["paper", "midpoints"])
def chart(request, femto) -> Proposal:
    plan = paper_protocol(femto, midpoints=request.param == "midpoints")
    found = identify(femto, simulate_um(femto, paper_truth(femto), plan, sigma=0.005, seed=3))
    return Proposal(PosteriorTarget(found.problem), found.solution.unknowns)


class TestCell:
    """Charts of the cell's own posterior."""

    def test_solutions_have_the_coordinates_asked_for(self, chart):
        normal = np.random.default_rng(0).standard_normal((200, 21))
        solved = chart.solve(normal)
        assert solved.inside.mean() > 0.9
        h, _, density = chart.coordinates(solved.points[solved.inside])
        assert_allclose(h, normal[solved.inside], rtol=0, atol=1e-7)
        assert_allclose(solved.log_density[solved.inside], density, rtol=0, atol=1e-6)

    def test_both_ways_give_the_same_density(self, chart):
        solved = chart.solve(np.random.default_rng(1).standard_normal((200, 21)))
        again = chart.log_proposal(solved.points[solved.inside])
        assert_allclose(again, solved.log_proposal[solved.inside], rtol=0, atol=1e-5)

    def test_density_is_the_jacobian_of_the_inverse_map(self, chart):
        """The density of v = g(e) is N(e) / |det dg/de|, with dg/de by differences of the solver itself."""
        normal = np.random.default_rng(2).standard_normal((4, 21))
        width = 1e-3
        for e, solved in zip(normal, chart.solve(normal).log_proposal, strict=True):
            ahead = chart.solve(e + width * np.eye(21)).points
            behind = chart.solve(e - width * np.eye(21)).points
            sign, log_determinant = np.linalg.slogdet((ahead - behind) / (2 * width))
            assert sign > 0
            assert solved == pytest.approx(-0.5 * (e @ e) - log_determinant, abs=0.02)

    def test_derivatives(self, chart):
        points = chart.solve(0.5 * np.random.default_rng(3).standard_normal((3, 21))).points
        _, slopes, _ = chart.coordinates(points)
        width = 1e-5
        for point, slope in zip(points, slopes, strict=True):
            ahead, _, _ = chart.coordinates(point + width * np.eye(21))
            behind, _, _ = chart.coordinates(point - width * np.eye(21))
            assert_allclose((ahead - behind).T / (2 * width), slope, rtol=1e-5, atol=1e-3)

    def test_many_points_give_what_few_give(self, chart):
        normal = np.random.default_rng(4).standard_normal((70, 21))
        together = chart.solve(normal)
        apart = [chart.solve(normal[i : i + 7]) for i in range(0, 70, 7)]
        assert (together.inside == np.concatenate([part.inside for part in apart])).all()
        inside = together.inside
        found = np.concatenate([part.points for part in apart])
        assert_allclose(found[inside], together.points[inside], rtol=0, atol=1e-5)

    def test_residuals_alone_are_those_with_derivatives(self, chart):
        points = np.random.default_rng(5).standard_normal((5, 21))
        # Thousands of standard deviations, with rounding of 1e-16 of a millimetre over nanometres.
        assert_allclose(chart.target.data_residuals(points), chart.target.data_batch(points)[0], rtol=1e-12, atol=1e-8)


class TestLinear:
    """On a linear problem the chart is the posterior."""

    def test_proposes_the_target_itself(self):
        target = LinearTarget(6)
        chart = Proposal(target, np.full(6, 0.3))
        solved = chart.solve(np.random.default_rng(0).standard_normal((50, 6)))
        assert solved.inside.all()
        difference = solved.log_density - solved.log_proposal
        assert_allclose(difference, difference[0], rtol=0, atol=1e-6)

    def test_volume(self):
        target = LinearTarget(6)
        variances = target.moments[1]
        assert Proposal(target, np.zeros(6)).log_volume == pytest.approx(-0.5 * np.log(variances).sum())


class TestFold:
    """The cubic: rows 2 (v^3 - v) and v, whose slopes at the reference point 1 are 4 and 1, so that h is known."""

    @pytest.fixture
    def chart(self) -> Proposal:
        return Proposal(CubicTarget(), np.array([1.0]))

    @staticmethod
    def h(v: np.ndarray) -> np.ndarray:
        return (4.0 * 2.0 * (v**3 - v) + v) / np.sqrt(17.0)

    #: Where h turns: 24 v^2 - 8 + 1 = 0.
    TURN = np.sqrt(7.0 / 24.0)

    def test_coordinates(self, chart):
        v = np.linspace(-2, 2, 9)
        assert_allclose(chart.coordinates(v[:, None])[0][:, 0], self.h(v), rtol=0, atol=1e-12)

    def test_beyond_the_fold_nothing_is_proposed(self, chart):
        v = np.linspace(-self.TURN + 1e-3, self.TURN - 1e-3, 101)
        assert np.isneginf(chart.log_proposal(v[:, None])).all()

    def test_inside_it_is_the_density_of_the_map(self, chart):
        v = np.linspace(self.TURN + 0.2, 2.0, 50)
        slope = (24.0 * v**2 - 7.0) / np.sqrt(17.0)
        assert_allclose(chart.log_proposal(v[:, None]), np.log(slope) - 0.5 * self.h(v) ** 2, rtol=0, atol=1e-6)

    def test_each_coordinate_leads_to_one_point_only(self, chart):
        """Of the two rising branches a coordinate has, the density holds only the one the solver takes."""
        lowest, highest = self.h(np.array([self.TURN, -self.TURN]))
        e = np.linspace(lowest + 0.05, highest - 0.05, 40)
        branches = np.array([np.sort(np.roots([8.0, 0.0, -7.0, -np.sqrt(17.0) * x]).real) for x in e])
        proposed = np.isfinite(chart.log_proposal(branches.reshape(-1, 1))).reshape(branches.shape)
        assert not proposed[:, 1].any()
        assert (proposed.sum(axis=1) <= 1).all()
        assert proposed.sum() >= 30

    def test_proposals_integrate_to_the_share_that_is_solved(self, chart):
        """The density over all v is the probability that a normal number leads to a point."""
        v = np.linspace(-3.0, 3.0, 60_001)
        total = np.exp(chart.log_proposal(v[:, None])).sum() * (v[1] - v[0]) / np.sqrt(2.0 * np.pi)
        e = np.linspace(-8.0, 8.0, 4001)
        weights = np.exp(-0.5 * e**2)
        solved = (weights * chart.solve(e[:, None]).inside).sum() / weights.sum()
        assert total == pytest.approx(solved, abs=2e-3)

    def test_a_flat_start_leads_nowhere_without_an_error(self):
        """Where the slopes are singular, there is no step."""

        class Flat(ToyTarget):
            n_unknowns = 1

            def data_batch(self, points):
                return 1e3 * (points - 1.0) ** 2 - points, (2e3 * (points - 1.0) - 1.0)[:, :, None]

        solved = Proposal(Flat(), np.array([1.0])).solve(np.linspace(-5.0, 5.0, 11)[:, None])
        assert not np.isnan(solved.points).any()
        assert np.isneginf(solved.log_proposal[~solved.inside]).all()

    def test_points_that_are_no_numbers_are_outside(self):
        class Broken(TwistedTarget):
            def data_batch(self, points):
                residuals, jacobian = super().data_batch(points)
                return np.where(points[:, :1] > 0.5, np.nan, residuals), jacobian

        target = Broken(3)
        solved = Proposal(target, target.references[0]).solve(np.random.default_rng(0).standard_normal((200, 3)))
        assert 0 < solved.inside.sum() < 200
        assert np.isfinite(solved.log_density[solved.inside]).all()
