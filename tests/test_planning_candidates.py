"""Candidate sweeps keep to what joints and interferometer can do."""

import numpy as np
import pytest
from conftest import DATA
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.candidates import SweepLimits, candidate_sweeps, controllers, reverses
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.joint_path import travel_seconds

CELL = load_cell(mechanics="none")


def tilts(cell: Cell, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Angles between mirror normal and optical axis by 4x4 products, in deg."""
    vector = CavityModel.of(cell).vector(values)
    axis = chain.optical_axis(cell, vector)
    normals = np.array([chain.mirror_pose(cell, vector, pose)[:3, 2] for pose in q])
    return np.degrees(np.arccos(np.clip(np.abs(normals @ axis), 0.0, 1.0)))


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), tilt=st.floats(1.0, 8.0), rate=st.floats(20.0, 2000.0), several=st.booleans())
def test_candidates_keep_to_the_limits(seed: int, tilt: float, rate: float, several: bool) -> None:
    limits = SweepLimits(tilt=np.radians(tilt), fringe_rate=rate)
    sweeps = candidate_sweeps(CELL, n=10, rng=np.random.default_rng(seed), limits=limits, several=several)
    check_sweeps(sweeps, CELL)
    groups = controllers(CELL)
    for found in (sweeps,):
        along = np.linspace(0.0, 1.0, 5)[:, None, None]
        q = found.q_start + along * (found.q_end - found.q_start)
        assert tilts(CELL, CELL.free.nominal, q.reshape(-1, 6)).max(initial=0.0) <= tilt + 1e-6
        seconds = travel_seconds(CELL, found.q_end - found.q_start)
        model = CavityModel.of(CELL)
        whole = model.predict(CELL.free.nominal, model.rows(found.q_start, found.q_end))
        assert (np.abs(whole) <= (1 + 1e-9) * rate * seconds * CELL.wavelength / 2).all()
        for moved in found.q_start != found.q_end:
            assert any(set(np.flatnonzero(moved)) <= set(group.tolist()) for group in groups)
            assert several or moved.sum() == 1


def test_same_seed_same_candidates() -> None:
    first, again, other = (candidate_sweeps(CELL, n=30, rng=np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.q_start, again.q_start)
    assert (first.q_start != other.q_start).any()


def test_other_chain_without_controllers() -> None:
    cell = load_cell(DATA / "xy-theta.toml", mechanics="none")
    sweeps = candidate_sweeps(cell, n=50, rng=np.random.default_rng(0))
    assert ((sweeps.q_start != sweeps.q_end).sum(axis=1) == 1).all()


def test_reversal_of_a_tilt_at_the_centre(femto: Cell) -> None:
    # The mirror turns about an axis that it stands 20 um off: its distance has an extremum in the middle of the turn.
    limits = SweepLimits(tilt=np.radians(8.0))
    sweeps = candidate_sweeps(femto, n=200, rng=np.random.default_rng(0), limits=limits)
    model = CavityModel.of(femto)
    values = femto.free.nominal + 0.3 * femto.free.prior_sd
    found = reverses(model, values, sweeps)
    for number in (*np.flatnonzero(found[0])[:5], *np.flatnonzero(~found[0])[:5]):
        along = np.linspace(0.0, 1.0, 2001)[:, None]
        q = sweeps.q_start[number] + along * (sweeps.q_end[number] - sweeps.q_start[number])
        steps = np.diff(model.predict(values, model.pose_rows(q)))
        back = min(steps.clip(min=0).sum(), (-steps).clip(min=0).sum())
        # Nine points see nearly all of what 2001 see.
        assert (back > femto.wavelength / 4) == found[0, number] or 0.7 < back / (femto.wavelength / 4) < 1.4


def test_impossible_limits(femto: Cell) -> None:
    rng = np.random.default_rng(0)
    moved = femto.free.nominal + 0.2 * femto.free.prior_sd
    with pytest.raises(InputError, match=r"only \d+ of \d+ random sweeps .* expected wider limits"):
        candidate_sweeps(femto, n=50, rng=rng, values=moved, limits=SweepLimits(fringe_rate=1e-9))
    tilted = femto.free.nominal.copy()
    tilted[femto.free.position("beta_et")] = np.radians(10.0)
    with pytest.raises(InputError, match="off the optical axis with all joints at zero"):
        candidate_sweeps(femto, n=5, rng=rng, values=tilted)
    with pytest.raises(InputError, match="limit tilt of a sweep: expected a number above zero"):
        SweepLimits(tilt=-1.0)
    with pytest.raises(InputError, match="limit tilt of a sweep: expected less than 90 deg, found 400"):
        SweepLimits(tilt=np.radians(400.0))


def test_a_joint_with_hardly_any_room_stays(femto: Cell) -> None:
    sweeps = candidate_sweeps(femto, n=40, rng=np.random.default_rng(0), limits=SweepLimits(tilt=np.radians(1e-6)))
    assert not sweeps.q_start[:, 3:5].any()
    assert not sweeps.q_end[:, 3:5].any()
    assert ((sweeps.q_start != sweeps.q_end).sum(axis=0) > 0)[[0, 1, 2, 5]].all()
