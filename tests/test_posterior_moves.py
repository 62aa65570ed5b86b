import numpy as np
import pytest
from arviz_stats.base import array_stats
from toy_targets import LinearTarget, TwistedTarget, run_moves

from fpcal_bayes.infer.posterior.moves import LocalMove, RandomiseThenOptimiseMove
from fpcal_bayes.infer.posterior.proposal import ProposalMixture

N_WALKERS = 256
TARGETS = [LinearTarget(5), LinearTarget(20), TwistedTarget(5), TwistedTarget(20)]
NAMES = ["normal-5", "normal-20", "twisted-5", "twisted-20"]
BENT, BENT_NAMES = TARGETS[2:], NAMES[2:]


def check_moments(draws: np.ndarray, target: LinearTarget | TwistedTarget) -> None:
    """Means and variances of draws (n_steps, n_walkers, n) within 4 standard errors, which are at most 1 %."""
    mean, variance = target.moments
    chains = draws.transpose(1, 0, 2)
    layout = {"chain_axis": 0, "draw_axis": 1}
    squares = (chains - mean) ** 2
    error = squares.std(axis=(0, 1)) / np.sqrt(array_stats.ess(squares, method="mean", **layout))
    assert (error <= 0.01 * variance).all()
    assert (np.abs(squares.mean(axis=(0, 1)) - variance) < 4 * error).all()
    error = np.sqrt(variance / array_stats.ess(chains, method="mean", **layout))
    assert (np.abs(chains.mean(axis=(0, 1)) - mean) < 4 * error).all()


def start_of(target: LinearTarget | TwistedTarget, n_walkers: int = N_WALKERS, seed: int = 1) -> np.ndarray:
    return target.draw(n_walkers, np.random.default_rng(seed))


def short_of_everything(target: LinearTarget | TwistedTarget) -> np.ndarray:
    """A start nowhere near the target's spread."""
    return target.references[0] + 0.01 * np.random.default_rng(2).standard_normal((N_WALKERS, target.n_unknowns))


class TestRandomiseThenOptimise:
    @pytest.mark.parametrize("target", BENT, ids=BENT_NAMES)
    def test_alone(self, target):
        atlas = ProposalMixture(target, target.references)
        move = RandomiseThenOptimiseMove(atlas, ahead=10)
        check_moments(run_moves(target, atlas, [move], short_of_everything(target), 270, 3)[10:], target)

    def test_proposals_made_ahead_are_forgotten(self):
        """Between two runs nothing is left over, so that a run that is taken up again draws the same."""
        target = LinearTarget(5)
        atlas = ProposalMixture(target, target.references)
        start = start_of(target)
        move = RandomiseThenOptimiseMove(atlas, ahead=7)
        first = run_moves(target, atlas, [move], start, 10, 3)
        move.forget()
        second = run_moves(target, atlas, [move], start, 10, 3)
        assert (first == second).all()

    def test_walkers_outside_every_chart_stay(self):
        """From there no proposal leads back, so none may lead away."""
        target = TwistedTarget(3, bend=1.0, apart=3.0)
        atlas = ProposalMixture(target, target.references[:1])
        outside = target.draw(2000, np.random.default_rng(0))
        outside = outside[np.isneginf(atlas.log_proposal(outside))][:64]
        assert len(outside) == 64
        draws = run_moves(target, atlas, [RandomiseThenOptimiseMove(atlas)], outside, 20, 4)
        assert (draws == target.straight(outside)).all()


class TestLocal:
    @pytest.mark.slow
    @pytest.mark.parametrize("target", BENT, ids=BENT_NAMES)
    def test_leaves_the_target_as_it_is(self, target):
        """Walkers that start as independent draws of the target are so after every step, whatever its length."""
        move = LocalMove(target, _Unasked())
        ends = [run_moves(target, _Unasked(), [move], start_of(target, 25_000, i), 5, i)[-1] for i in (6, 7)]
        end = np.concatenate(ends)
        mean, variance = target.moments
        squares = (end - mean) ** 2
        error = squares.std(axis=0) / np.sqrt(len(end))
        assert (error <= 0.01 * variance).all()
        assert (np.abs(squares.mean(axis=0) - variance) < 4 * error).all()
        assert (np.abs(end.mean(axis=0) - mean) < 4 * np.sqrt(variance / len(end))).all()

    def test_moves(self):
        """Accepted often, so that the test above does not hold because nothing happens."""
        target = TwistedTarget(20)
        start = start_of(target)
        end = run_moves(target, _Unasked(), [LocalMove(target, _Unasked())], start, 6, 7)[-1]
        assert ((end != target.straight(start)).any(axis=1)).mean() > 0.95


class TestMixture:
    @pytest.mark.parametrize("target", TARGETS, ids=NAMES)
    def test_both(self, target):
        atlas = ProposalMixture(target, target.references)
        moves = [(RandomiseThenOptimiseMove(atlas, ahead=10), 0.9), (LocalMove(target, atlas), 0.1)]
        check_moments(run_moves(target, atlas, moves, short_of_everything(target), 320, 8)[20:], target)

    @pytest.mark.slow
    @pytest.mark.parametrize(("d", "n_charts"), [(5, 1), (5, 2), (20, 2)])
    def test_two_modes(self, d, n_charts):
        """Modes of known weights with a fold between them, also where only one of them has a chart."""
        target = TwistedTarget(d, bend=1.0, apart=2.2, tilt=0.25)
        assert len(target.references) == 2
        atlas = ProposalMixture(target, target.references[:n_charts])
        moves = [(RandomiseThenOptimiseMove(atlas, ahead=10), 0.7), (LocalMove(target, atlas), 0.3)]
        # Without a chart of its own a mode is left and reached rarely: the start is right, and has to stay so.
        start = short_of_everything(target) if n_charts == 2 else start_of(target, 2000)
        draws = run_moves(target, atlas, moves, start, 120 if n_charts == 2 else 70, 9)[20:]
        right = (draws[:, :, 0] > 0).astype(float).T
        values, weights = target.grid
        exact = weights[values > 0].sum()
        assert 0.55 < exact < 0.9
        error = right.std() / np.sqrt(array_stats.ess(right, chain_axis=0, draw_axis=1, method="mean"))
        assert error < 0.01
        assert abs(right.mean() - exact) < 4 * error


class _Unasked:
    """Stands for an atlas where no move looks at it."""

    def log_proposal(self, points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points))
