"""Half wavelengths taken off rows: by the Woodbury identity, and by measuring again."""

from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, SIGMA, campaign

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.measure.protocol import add_midpoints
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking import measurement as rows_taken_in
from fpcal_bayes.tracking.corrections import correct_slips, row_changes
from fpcal_bayes.tracking.drift import State
from fpcal_bayes.tracking.filter import Innovation, predict
from fpcal_bayes.tracking.measurement import SweepMeasurement

HALF_WAVE = CELL.wavelength / 2.0


@pytest.fixture(scope="module")
def session():
    """A predicted state, and sweeps with midpoints, which share the reading at their start."""
    truth, sweeps = campaign(5, sessions=1, count=40)
    found = identify(CELL, sweeps.of_session("day0")).estimate
    state = predict(DRIFT, State(0.0, *DRIFT.initial(found.values, found.covariance)), 8.0)
    both = simulate_um(CELL, truth, add_midpoints(sweeps.of_session("s1")), sigma=SIGMA, seed=1)
    return state, replace(both, label=np.array([f"row {i}" for i in range(len(both))]))


def innovation_of(state, sweeps):
    measurement = SweepMeasurement.of(DRIFT, CavityModel.of(CELL), sweeps, state.mean)
    return measurement, Innovation.of(*measurement.linearise(state.mean), state.covariance, measurement.log_volume)


@pytest.mark.parametrize(("grouped", "count"), [(True, 80), (False, 40), (True, 8)])
def test_a_change_does_what_it_does_to_the_measured_rows(session, grouped, count):
    state, sweeps = session
    sweeps = (sweeps if grouped else sweeps.take(np.arange(len(sweeps)) % 2 == 0)).take(np.arange(count))
    rows, dl = row_changes(innovation_of(state, sweeps)[0], state), sweeps.dl.copy()
    for row, waves in ((7, 2), (count - 1, -1), (7, -3), (0, 1)):
        once = rows.squared - 2.0 * waves * rows.along[row] + waves**2 * rows.size[row]
        rows = rows.taken_off(row, waves)
        dl[row] -= waves * HALF_WAVE
        _, expected = innovation_of(state, sweeps.with_measurement(dl, sweeps.sigma))
        assert rows.squared == pytest.approx(expected.squared, rel=1e-9)
        assert once == pytest.approx(expected.squared, rel=1e-9)


@pytest.mark.parametrize("slips", [{}, {3: 1}, {3: 1, 20: -2, 61: 3}])
def test_slips_among_many_rows_are_corrected_alike_both_ways(session, slips, monkeypatch):
    state, sweeps = session
    dl = sweeps.dl.copy()
    for row, waves in slips.items():
        dl[row] += waves * HALF_WAVE
    # Where nothing slips, the rows are twice as noisy as stated, so that there is something to explain.
    noisy = sweeps.with_measurement(dl, sweeps.sigma / (1.0 if slips else 2.0))
    jumps = (np.full(DRIFT.n_states, 1e-3),)
    found = []
    for most in (1, 1000):
        monkeypatch.setattr(rows_taken_in, "_ROWS_PER_STATE", most)
        measurement, innovation = innovation_of(state, noisy)
        found.append(correct_slips(noisy, measurement, innovation, state, jumps))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]
    np.testing.assert_allclose(found[0][0], sweeps.dl, rtol=0, atol=1e-12)
    assert len(found[0][1]) == min(len(slips), 1)
