"""Calibrations with two solutions: both are followed until the sessions tell them apart."""

from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, PROTOCOL, SIGMA, plan

from fpcal_bayes.infer.design.candidates import candidate_sweeps
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.record import record_of, resume
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.solutions import LOOKS
from fpcal_bayes.tracking.tracker import calibrate, track

SESSIONS = 6
LIMITS = Limits()
#: A draw of the prior, of whose calibration the posterior has two minima.
START = CELL.free.nominal + CELL.free.prior_sd * np.random.default_rng([200, 213]).standard_normal(21)


def ambiguous(seed: int):
    random, times = np.random.default_rng(seed), 8.0 * np.arange(SESSIONS + 1)
    steps = random.standard_normal((SESSIONS + 1, 21)) * DRIFT.walk * DRIFT.scale * np.sqrt(8.0 / 24.0)
    steps[0] = 0.0
    parts = [replace(PROTOCOL, session=np.full(69, "day0"))]
    for i, time in enumerate(times[1:], 1):
        parts.append(replace(plan(6, random), session=np.full(6, f"s{i}"), time_h=np.full(6, time)))
    truth = Truth(CELL.free, times, START + np.cumsum(steps, axis=0))
    return simulate_um(CELL, truth, join(parts, file="campaign"), sigma=SIGMA, seed=seed)


@pytest.fixture(scope="module")
def told():
    """Sweeps by which the sessions tell the solutions apart."""
    return ambiguous(1)


def test_the_solution_that_the_sessions_show_is_followed(told):
    _, _, starts = calibrate(CELL, DRIFT, told.of_session("day0"))
    assert len(starts) == 2
    assert sum(share for _, share in starts) == pytest.approx(1.0)
    found = track(CELL, told)
    assert found.solutions == 2
    assert "of its 2 solutions the later sessions show which one holds" in found.outcomes[0].warnings[-1]
    assert {o.verdict for o in found.outcomes} == {"as-modelled"}
    # It is the one that is right about sweeps that nobody measured, and the other is not.
    model, asked = CavityModel.of(CELL), candidate_sweeps(CELL, n=300, rng=np.random.default_rng(1))
    rows = model.rows(asked.q_start, asked.q_end, asked.absolute)
    true = model.predict(START, rows)

    def error(outcome) -> float:
        return float(np.sqrt(np.mean((model.predict(DRIFT.values(outcome.state.mean), rows) - true) ** 2)))

    chosen = [np.array_equal(o.state.mean, found.outcomes[0].state.mean) for o, _ in starts]
    assert sum(chosen) == 1
    assert error(starts[chosen.index(True)][0]) < 0.5 * error(starts[chosen.index(False)][0])


def test_solutions_that_the_sessions_do_not_tell_apart_stay_together():
    sweeps = ambiguous(0)
    found = track(CELL, sweeps.take(sweeps.session != "s6"))
    assert found.solutions == 2
    assert not any("which one holds" in text for text in found.outcomes[0].warnings)
    together, _, _ = calibrate(CELL, DRIFT, sweeps.of_session("day0"))
    np.testing.assert_array_equal(found.outcomes[0].state.mean, together.state.mean)


def test_a_saved_track_is_not_taken_up_before_its_solutions_are_compared(told):
    early = told.take(np.isin(told.session, ["day0", "s1"]))
    saved = record_of(track(CELL, early), early, LIMITS)
    known, note = resume(saved, CELL, DRIFT, LIMITS, check_sessions(told), "file")
    assert SESSIONS < LOOKS
    assert known is None
    assert note == "its calibration has 2 solutions: all of its first sessions are taken in anew"


def test_nothing_new_leaves_the_saved_track_as_it_is(told):
    early = told.take(np.isin(told.session, ["day0", "s1"]))
    saved = record_of(track(CELL, early), early, LIMITS)
    known, note = resume(saved, CELL, DRIFT, LIMITS, check_sessions(early), "file")
    assert note == ""
    assert known.solutions == 2
    assert len(known.outcomes) == 2


def test_a_slip_that_nobody_noticed_takes_over_no_solution():
    """It drags every solution away; the alarms of each are no evidence for another."""
    sweeps = ambiguous(18)
    slipped = np.flatnonzero(sweeps.session == "s1")[0]
    dl = sweeps.dl.copy()
    dl[slipped] -= CELL.wavelength / 2.0
    found = track(CELL, sweeps.with_measurement(dl, sweeps.sigma))
    assert found.solutions == 2
    assert not any("which one holds" in text for text in found.outcomes[0].warnings)
