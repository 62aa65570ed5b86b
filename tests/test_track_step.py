"""Rows that are not what they seem, and identifications with stale values."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import CELL, DRIFT, SIGMA, campaign, knock, plan, step_of_beta_4

from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking import measurement as rows_taken_in
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.session import take_in
from fpcal_bayes.tracking.tracker import track


@pytest.fixture(scope="module")
def week():
    return campaign(1, sessions=4, hours=2.0)


def test_unsigned_sweeps_are_given_the_sign_that_is_expected(week):
    _, sweeps = week
    lost = replace(sweeps, signed=sweeps.session == "day0")
    lost = replace(lost, dl=np.where(lost.signed, lost.dl, np.abs(lost.dl)))
    signed, found = track(CELL, sweeps), track(CELL, lost)
    dropped = sum("cannot be told" in text for o in found.outcomes[1:] for text in o.warnings)
    assert sum(o.n_sweeps for o in found.outcomes[1:]) >= 24 - 6
    for a, b in zip(signed.outcomes[1:], found.outcomes[1:], strict=True):
        if a.n_sweeps == b.n_sweeps and not dropped:
            np.testing.assert_allclose(a.state.mean, b.state.mean)
    assert {o.verdict for o in found.outcomes} == {"as-modelled"}


def test_a_slipped_fringe_count_is_corrected_and_said(week):
    _, sweeps = week
    row = int(np.flatnonzero(sweeps.session == "s3")[1])
    dl = sweeps.dl.copy()
    dl[row] += CELL.wavelength
    clean, found = track(CELL, sweeps), track(CELL, sweeps.with_measurement(dl, sweeps.sigma))
    assert found.outcomes[3].verdict == "as-modelled"
    assert found.outcomes[3].warnings == (
        f"fringe counts slipped, corrected by whole half wavelengths: {sweeps.label[row]} (-2)",
    )
    np.testing.assert_allclose(found.last.state.mean, clean.last.state.mean, atol=1e-9)


def test_a_slip_in_the_calibration_is_corrected(week):
    _, sweeps = week
    dl = sweeps.dl.copy()
    dl[3] -= CELL.wavelength
    found = track(CELL, sweeps.with_measurement(dl, sweeps.sigma))
    assert any("fringe counts slipped" in text for text in found.outcomes[0].warnings)
    assert {o.verdict for o in found.outcomes} == {"as-modelled"}


@pytest.fixture(scope="module")
def calibrated(week):
    return track(CELL, week[1].of_session("day0")).last


CHANGES = {
    "quiet": (np.zeros(21), "as-modelled"),
    "knock": (knock(np.random.default_rng(2)), "extrinsics-moved"),
    "robot": (2.0 * step_of_beta_4(), "intrinsics-moved"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_session_of_many_rows_is_judged_alike_both_ways(calibrated, what, monkeypatch):
    change, verdict = CHANGES[what]
    sweeps = campaign(4, sessions=1, hours=4.0, count=60, change=change, changed=1)[1].of_session("s1")
    found = []
    for most in (2, 1000):
        monkeypatch.setattr(rows_taken_in, "_ROWS_PER_STATE", most)
        model = CavityModel.of(CELL)
        found.append(take_in(DRIFT, model, Limits(), calibrated.state, calibrated.monitor, sweeps))
    few, whole = found
    assert few.verdict == whole.verdict == verdict
    assert (few.evidence, few.warnings, few.dof) == (whole.evidence, whole.warnings, 60)
    assert few.nis == pytest.approx(whole.nis, rel=1e-9)
    assert few.log_likelihood == pytest.approx(whole.log_likelihood, rel=1e-9)
    np.testing.assert_allclose(few.state.mean, whole.state.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(few.state.covariance, whole.state.covariance, rtol=0, atol=1e-9)
    for a, b in zip(few.monitor.onsets, whole.monitor.onsets, strict=True):
        np.testing.assert_allclose(a.information, b.information, atol=1e-7 * np.abs(b.information).max())
        np.testing.assert_allclose(a.score, b.score, atol=1e-7 * (1.0 + np.abs(b.score).max()))


def test_a_session_of_thousands_of_rows_forms_no_matrix_of_rows_by_rows(calibrated):
    rows = plan(4000, np.random.default_rng(0))
    sweeps = simulate_um(CELL, paper_truth(CELL), replace(rows, time_h=np.full(4000, 2.0)), sigma=SIGMA, seed=1)
    dl = sweeps.dl.copy()
    dl[[17, 3000]] += CELL.wavelength
    slipped = sweeps.with_measurement(dl, sweeps.sigma)
    tracemalloc.start()
    found = take_in(DRIFT, CavityModel.of(CELL), Limits(), calibrated.state, calibrated.monitor, slipped)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (found.verdict, found.dof) == ("as-modelled", 4000)
    assert "corrected by whole half wavelengths" in found.warnings[0]
    # One matrix of rows by rows takes 122 MiB.
    assert peak < 30 * 2**20


def test_one_sweep_is_enough_and_paths_are_left_out(week):
    _, sweeps = week
    one = sweeps.take((sweeps.session == "day0") | (sweeps.label == "q3-2"))
    path = replace(one.take(np.array([-1])), session=np.array(["check"]), time_h=np.array([9.0]))
    path = replace(path, kind=np.array(["path"]))
    found = track(CELL, join([one, path]))
    assert [o.dof for o in found.outcomes[1:]] == [1, 1, 1, 1, 0]
    assert found.last.warnings == ("1 row of kind path not used",)
    before, after = found.outcomes[-2].state, found.last.state
    assert (np.diag(after.covariance) >= np.diag(before.covariance)).all()


def test_a_logged_temperature_drives_the_parameters():
    """A truth that follows the temperature: with the coefficient in the cell all is as modelled, without it is not."""
    truth, sweeps = campaign(3, sessions=5)
    degrees = 20.0 + 3.0 * (np.arange(6) % 2)
    at = CELL.free.position("x_wf")
    values = truth.values.copy()
    values[:, at] += 2.0 * (degrees - 20.0)
    warm = replace(sweeps, temperature_c=degrees[np.searchsorted(truth.times_h, sweeps.time_h)])
    measured = simulate_um(CELL, replace(truth, values=values), warm, sigma=0.005, seed=3)
    sizes = [replace(s, temperature=2.0) if s.name == "x_wf" else s for s in CELL.drift]
    learning = [replace(s, temperature_sd=3.0) if s.name == "x_wf" else s for s in CELL.drift]
    for drift in (sizes, learning):
        found = track(replace(CELL, drift=tuple(drift)), measured)
        assert {o.verdict for o in found.outcomes} == {"as-modelled"}
    # The coefficient has been learnt: 2 um/K.
    coefficient, sd = 3.0 * found.last.state.mean[21], 3.0 * np.sqrt(found.last.state.covariance[21, 21])
    assert abs(coefficient - 2.0) < 4 * sd < 1.5
    assert "extrinsics-moved" in [o.verdict for o in track(CELL, measured).outcomes]
