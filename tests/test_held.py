"""Parameters that are held: at their prior, at an earlier estimate, as exact."""

import numpy as np
import pytest

import fpcal_bayes as fp
from fpcal_bayes.infer import independent_draws
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth

CELL = fp.load_cell(mechanics="none")
EXTRINSIC = CELL.free.positions(CELL.select("extrinsic").names)


def drawn(seed: int) -> np.ndarray:
    return CELL.free.nominal + CELL.free.prior_sd * np.random.default_rng(seed).standard_normal(len(CELL.free))


def measured(values: np.ndarray, plan: Sweeps, seed: int) -> Sweeps:
    return fp.simulate(CELL, Truth(CELL.free, np.zeros(1), values[None]), plan, sigma_nm=5, seed=seed)


def test_the_rest_at_its_prior_is_followed_over_degrees():
    """Extrinsics of cells whose intrinsics are a degree off nominal: every error within what is stated."""
    z = []
    for seed in range(6):
        values = drawn(seed)
        found = fp.identify(CELL, measured(values, fp.paper_protocol(CELL), seed), free="extrinsic", seed=seed)
        assert found.converged
        assert found.estimate.trust.usable
        z.append(((values - found.estimate.values) / found.estimate.sd)[EXTRINSIC])
        held = np.setdiff1d(np.arange(len(CELL.free)), EXTRINSIC)
        # What is held stays where it was, as uncertain as it was.
        np.testing.assert_allclose(found.estimate.values[held], CELL.free.nominal[held])
        np.testing.assert_allclose(found.estimate.sd[held], CELL.free.prior_sd[held])
        assert {found.estimate.status[i] for i in held} == {"fixed"}
        assert found.spectrum.rank <= len(EXTRINSIC)
    # 99.9 % of chi-square over 48 lies below 1.75, below 0.5 hardly any.
    assert 0.4 < np.mean(np.square(z)) < 1.75


def test_draws_of_what_is_free_beside_what_is_held():
    found = fp.identify(CELL, measured(drawn(1), fp.paper_protocol(CELL), 1), free="extrinsic")
    draws = independent_draws(found)
    assert draws.shape == (500, len(EXTRINSIC))
    names = found.free.names
    for name in ("beta_et", "theta_wf", "x_wf"):
        i = names.index(name)
        stated = found.estimate.sd[found.estimate.parameters.position(name)]
        assert draws[:, i].std() == pytest.approx(stated, rel=0.2)


def test_held_values_that_hardly_hold_are_refused():
    """A start of twelve sweeps knows the robot to half a degree: no line holds over that."""
    values, plan = drawn(6), fp.paper_protocol(CELL)
    few = plan.take(np.random.default_rng(3).permutation(len(plan))[:12])
    again = measured(values, plan, 4)
    start = fp.identify(CELL, measured(values, few, 3)).estimate
    found = fp.identify(CELL, again, free="extrinsic", start=start)
    assert not found.estimate.trust.usable
    assert any("too uncertain to be held" in text for text in found.warnings)
    good = fp.identify(CELL, measured(values, plan, 3)).estimate
    assert fp.identify(CELL, again, free="extrinsic", start=good).estimate.trust.usable


def test_what_is_left_out_is_no_zero():
    """With the robot held as exact no sweep of the mirror moves the spin: its error is not known, not 0.0 nm."""
    values, plan = drawn(5), fp.paper_protocol(CELL)
    start = fp.identify(CELL, measured(values, plan, 5)).estimate
    exact = fp.identify(CELL, measured(values, plan, 6), free="extrinsic", start=start, hold="exact").estimate
    assert exact.trust.usable
    assert "held-exact" in [reason.kind for reason in exact.trust.reasons]
    spin = fp.predict_from_covariance(exact, fp.find_task(CELL, exact.vector(), "spin", n_points=9))
    assert not spin.trust.usable
    with pytest.raises(fp.InputError, match="its error is not known"):
        spin.band()
    held = fp.identify(CELL, measured(values, plan, 6), free="extrinsic", start=start).estimate
    spin = fp.predict_from_covariance(held, fp.find_task(CELL, held.vector(), "spin", n_points=9))
    assert 1e3 * spin.sd.max() > 1.0
