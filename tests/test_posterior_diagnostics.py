import numpy as np
import pytest
from scipy.signal import lfilter

from fpcal_bayes.infer.posterior.diagnostics import LEAST_LENGTH, diagnose

SHAPE = (4, 200, 32, 3)


def independent(shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(shape)


def persistent(share: float, n_steps: int) -> np.ndarray:
    """Chains in which each draw keeps `share` of the last; their autocorrelation time is (1 + share) / (1 - share)."""
    noise = independent((4, n_steps + 200, 32, 2))
    return lfilter([np.sqrt(1 - share**2)], [1.0, -share], noise, axis=1)[:, 200:]


class TestDiagnose:
    def test_independent_draws(self):
        found = diagnose(independent())
        total = 4 * 200 * 32
        assert found.ess_bulk == pytest.approx(np.full(3, total), rel=0.1)
        assert found.ess_tail == pytest.approx(np.full(3, total), rel=0.15)
        assert (found.rhat < 1.001).all()
        assert found.autocorrelation_time == pytest.approx(1.0, rel=0.1)
        assert found.length == 200
        assert found.failures(20_000) == []

    def test_autocorrelation(self):
        found = diagnose(persistent(0.8, 1000))
        assert found.autocorrelation_time == pytest.approx(9.0, rel=0.15)
        assert found.ess_bulk == pytest.approx(np.full(2, 4 * 1000 * 32 / 9.0), rel=0.15)

    def test_one_ensemble_elsewhere(self):
        draws = independent()
        draws[2, :, :, 1] += 0.5
        found = diagnose(draws)
        assert found.rhat[1] > 1.01
        assert (found.rhat[[0, 2]] < 1.001).all()
        assert found.failures(10)[0].startswith(f"nested R-hat {found.rhat[1]:.3f}")

    def test_plain_rhat_would_fail_short_chains_that_are_fine(self):
        """Walkers as chains of a few autocorrelation times, but many of them: what nested R-hat is for."""
        assert (diagnose(persistent(0.8, 180)).rhat < 1.01).all()

    def test_effective_size_is_the_least_of_all(self):
        found = diagnose(persistent(0.5, 300))
        assert found.effective == min(*found.ess_bulk, *found.ess_tail)


class TestFailures:
    def test_too_few(self):
        found = diagnose(independent())
        (failure,) = found.failures(10**6)
        assert failure == f"{found.effective:.0f} effective draws of the worst parameter, expected 1000000"

    def test_too_short(self):
        found = diagnose(persistent(0.9, 300))
        (failure,) = found.failures(100)
        assert failure.startswith("300 steps of ")
        assert failure.endswith(f"expected {LEAST_LENGTH} times as many")

    def test_chains_that_stand_still(self):
        draws = np.broadcast_to(np.random.default_rng(0).standard_normal((4, 1, 32, 2)), (4, 60, 32, 2))
        assert diagnose(draws.copy()).failures(100)
