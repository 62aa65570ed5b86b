"""Terms that a drift gets where a temperature is logged."""

from dataclasses import replace

import numpy as np
from track_fixtures import CELL, DRIFT, SIGMA, campaign

from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.drift import likely_drift, likely_terms
from fpcal_bayes.tracking.tracker import track

TRUTH, SWEEPS = campaign(3, sessions=18, hours=4.0, count=4)


def test_only_a_logged_temperature_adds_terms_and_only_to_walks():
    assert likely_drift(CELL, SWEEPS) == DRIFT
    logged = replace(SWEEPS, temperature_c=np.full(len(SWEEPS), 20.0))
    found = likely_drift(CELL, logged)
    assert found == likely_terms(DRIFT)
    named = [size.name for size in found.sizes if size.rate_sd and size.temperature_sd]
    assert named == ["beta_et", "theta_et", "beta_wf", "theta_wf"]
    stated = replace(CELL, drift=tuple(replace(size, rate_sd=1e-6) for size in CELL.drift))
    assert likely_drift(stated, logged).sizes == tuple(
        next((s for s in stated.drift if s.name == p.name), type(DRIFT.sizes[0])(p.name)) for p in CELL.free
    )


def test_a_cycle_of_the_room_is_found_and_a_still_room_costs_little():
    kelvin = 2.0 * np.sin(2.0 * np.pi * TRUTH.times_h / 24.0)
    moved = np.where([p.name == "beta_wf" for p in CELL.free], np.radians(0.02), 0.0)
    gain = {}
    for name, values in (("cycle", TRUTH.values + kelvin[:, None] * moved), ("still", TRUTH.values)):
        sweeps = simulate_um(CELL, Truth(CELL.free, TRUTH.times_h, values), SWEEPS, sigma=SIGMA, seed=5)
        row = np.searchsorted(TRUTH.times_h, sweeps.time_h)
        logged = replace(sweeps, temperature_c=20.0 + kelvin[row])
        found = track(CELL, logged)
        known = track(CELL, logged, drift=DRIFT)
        told, less = (sum(o.log_likelihood for o in each.outcomes[1:]) for each in (found, known))
        gain[name] = told - less
        if name == "cycle":
            n, size = DRIFT.n_parameters, found.drift.sizes[CELL.free.names.index("beta_wf")]
            coefficients = found.last.state.mean[n + 4 :]
            sd = np.sqrt(np.diag(found.last.state.covariance))[n + 4 :]
            assert abs(coefficients[2] * size.temperature_sd - np.radians(0.02)) < 4.0 * sd[2] * size.temperature_sd
            assert sd[2] < 0.8
    # A hundred to one.
    assert gain["cycle"] > np.log(100.0)
    assert gain["still"] > -6.0
