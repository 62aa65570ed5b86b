"""A track of a real machine: error motions are states, and what is heavy-tailed raises no alarm."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from fpcal_bayes import (
    Campaign,
    Costs,
    Goal,
    decide_track,
    load_cell,
    paper_protocol,
    paper_truth,
    read_sweeps,
    write_sweeps,
)
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.measure import Sweeps, drive_of_sweeps, join
from fpcal_bayes.model import CavityModel
from fpcal_bayes.model.mechanics import path_design
from fpcal_bayes.simulator import Machine
from fpcal_bayes.tracking import track
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.record import record_of, resume
from fpcal_bayes.tracking.tracker import _identified, calibrate

CELL = load_cell()
MODEL, DRIFT = CavityModel.of(CELL), DriftModel.of(CELL)
SIGMA = 0.005
HIGH = np.array([150.0, 150.0, 150.0, *np.radians([3.0, 3.0, 90.0])])


def session(name: str, hour: float, plan: Sweeps, machine: Machine, change: dict[str, float] | None = None) -> Sweeps:
    """A plan measured on a machine whose parameters have changed, in um and rad."""
    vector = machine.vector.copy()
    for parameter, by in (change or {}).items():
        vector[CELL.parameters[parameter].slot] += by
    drive = drive_of_sweeps(plan, CELL.mechanics.minutes_per_sweep)
    dl = replace(machine, vector=vector).sweep(drive, SIGMA)
    named = replace(plan, session=np.full(len(plan), name), time_h=np.full(len(plan), hour))
    return named.with_measurement(dl, SIGMA)


def varied(rng: np.random.Generator) -> Sweeps:
    """One sweep of each joint over its range, from random poses."""
    start = rng.uniform(-HIGH, HIGH, (6, 6))
    end, joint = start.copy(), np.arange(6)
    start[joint, joint], end[joint, joint] = -HIGH, HIGH
    return Sweeps.of_um_rad(start, end, label=[f"q{j + 1}" for j in joint])


@pytest.fixture(scope="module")
def machine() -> Machine:
    vector = CELL.parameters.nominal.copy()
    truth = paper_truth(CELL)
    vector[truth.parameters.slots] = truth.at(0.0)
    return Machine.draw(CELL, CELL.mechanics, vector, np.random.default_rng(3))


@pytest.fixture(scope="module")
def sweeps(machine, tmp_path_factory) -> Sweeps:
    """A calibration and three sessions of a machine that stays as it is."""
    rng = np.random.default_rng(4)
    first = session("full", 0.0, paper_protocol(CELL, midpoints=True), machine)
    whole = join([first, *(session(f"s{k}", 2.0 * k, varied(rng), machine) for k in range(1, 4))])
    # As a file holds them, in degrees.
    file = tmp_path_factory.mktemp("machine") / "sweeps.csv"
    write_sweeps(file, whole, CELL)
    return read_sweeps(file, CELL)


@pytest.fixture(scope="module")
def followed(sweeps):
    return track(CELL, sweeps, drift=DRIFT)


def test_after_the_calibration_lengths_are_known_as_dense_algebra_says(sweeps):
    """The state's mean and covariance along a path, beside the conditional normal of all weights written out."""
    first = calibrate(CELL, DRIFT, sweeps.of_session("full"))[0]
    motions, n = first.motions, DRIFT.n_parameters
    found = _identified(CELL, DRIFT, sweeps.of_session("full"))[0]
    fit = found.machine
    # Independent: the sizes by quadrature, the posterior of each carried over to a prior of a factor of 1.5 around the
    # sheet; the rows' covariance from the design matrices at these sizes, without states or whitening.
    log = np.round(fit.scales.log, 3)
    grid = np.linspace(-8.0, 8.0, 16001)[:, None]
    wide = np.log(np.append(np.full(log.shape[1] - 1, 3.0), 1.5))
    density = ((grid - log.mean(axis=0)) / log.std(axis=0)) ** 2 + (grid / np.log(1.5)) ** 2 - (grid / wide) ** 2
    weight = np.exp(-0.5 * (density - density.min(axis=0)))
    middle = (grid * weight).sum(axis=0) / weight.sum(axis=0)
    variance = ((grid - middle) ** 2 * weight).sum(axis=0) / weight.sum(axis=0)
    values, factors = fit.values, np.exp(middle)
    # Beside approach, drift, encoder, slow noise, return and noise none is below what is stated, and each is as large
    # as its root mean square over what is unknown of it.
    assert (factors[:-6] < 1.0).any()
    factors[:-6] = np.maximum(factors[:-6], 1.0) * np.exp(variance[:-6])
    readings, returns = fit.noise.dense()
    noise = factors[-1] ** 2 * readings + factors[-2] ** 2 * returns
    weights = fit.design.matrix * factors[fit.design.scale]
    rows = found.problem.rows
    predicted, jacobian = MODEL.predict_with_jacobian(values, rows)
    columns = np.hstack([jacobian * CELL.free.prior_sd, weights])
    at = np.concatenate([(values - CELL.free.nominal) / CELL.free.prior_sd, np.zeros(weights.shape[1])])
    gain = linalg.solve(columns @ columns.T + noise, columns, assume_a="pos").T
    mean = gain @ (found.problem.target - predicted + columns @ at)
    covariance = np.eye(len(at)) - gain @ columns
    poses = np.random.default_rng(8).uniform(-HIGH, HIGH, (12, 6))
    start = np.zeros(6)
    _, slopes = MODEL.predict_with_jacobian(values, MODEL.rows(np.zeros((12, 6)), poses))
    felt = path_design(fit.terms, MODEL.vector(values), start, poses).motions
    shared = felt.shape[1]
    full = np.zeros((12, len(at)))
    full[:, :n] = slopes * CELL.free.prior_sd
    full[:, n : n + shared] = felt * factors[fit.design.scale[:shared]]
    states = np.hstack([slopes * CELL.free.prior_sd, felt @ motions.basis])
    sd = np.sqrt(np.einsum("pi,ij,pj->p", full, covariance, full))
    own = np.sqrt(np.einsum("pi,ij,pj->p", states, first.state.covariance, states))
    # What the states leave out counts as noise.
    np.testing.assert_allclose(own, sd, rtol=0.02)
    assert np.abs(states @ first.state.mean - full @ mean).max() < 0.02 * sd.max()


def test_a_quiet_machine_is_as_modelled_and_trusted(followed):
    assert [outcome.verdict for outcome in followed.outcomes] == ["as-modelled"] * 4
    assert "mechanics-left-out" not in {reason.kind for reason in followed.trust.reasons}
    assert followed.estimate().mechanics is not None


def test_a_knock_is_one_of_mirror_and_fibre(machine, sweeps, followed):
    knock = {p.name: np.radians(0.1) if p.unit == "deg" else 20.0 for p in CELL.free if p.kind == "extrinsic"}
    last = session("s4", 9.0, varied(np.random.default_rng(6)), machine, knock)
    found = track(CELL, join([sweeps, last]), drift=DRIFT, known=followed)
    assert found.last.verdict == "extrinsics-moved"


def test_a_reading_far_off_is_set_aside(machine, sweeps, followed):
    last = session("s4", 7.0, varied(np.random.default_rng(7)), machine)
    dl = last.dl.copy()
    dl[2] += 0.23
    found = track(CELL, join([sweeps, last.with_measurement(dl, last.sigma)]), drift=DRIFT, known=followed)
    assert found.last.verdict == "as-modelled"
    assert any("left out: q3" in text for text in found.last.warnings)
    plain = track(CELL, join([sweeps, last]), drift=DRIFT, known=followed)
    # What is left out changes the estimate no more than its own reading would have told.
    n = DRIFT.n_parameters
    away = found.last.state.mean[:n] - plain.last.state.mean[:n]
    assert (np.abs(away) < 2.0 * np.sqrt(np.diag(found.last.state.covariance)[:n])).all()


def test_error_motions_that_change_are_told_from_the_geometry(machine, sweeps, followed):
    other = Machine.draw(CELL, CELL.mechanics.scaled(12.0), machine.vector, np.random.default_rng(11))
    moved = replace(machine, motions=other.motions)
    last = session("s4", 7.0, varied(np.random.default_rng(9)), moved)
    found = track(CELL, join([sweeps, last]), drift=DRIFT, known=followed)
    assert found.last.verdict == "mechanics-moved"
    assert found.calibration_due == "s4"


def test_a_saved_track_is_small_and_goes_on_where_it_ended(followed, sweeps, tmp_path):
    limits = Limits()
    record = record_of(followed, sweeps, limits)
    campaign = Campaign.of(sweeps, CELL, command="")
    write_campaign(tmp_path / "plain.h5", campaign, CELL)
    write_campaign(tmp_path / "c.h5", replace(campaign, track=record), CELL)
    size = (tmp_path / "c.h5").stat().st_size - (tmp_path / "plain.h5").stat().st_size
    assert size <= 50_000 * len(followed.outcomes)
    saved = read_campaign(tmp_path / "c.h5", CELL)
    parts = [saved.sweeps.of_session(name) for name in saved.sweeps.sessions]
    taken_up, note = resume(saved.track, CELL, DRIFT, limits, parts[:3], "c.h5")
    assert taken_up is None
    assert "anew" in note or "with all" in note
    taken_up, note = resume(saved.track, CELL, DRIFT, limits, parts, "c.h5")
    assert note == ""
    rng = np.random.default_rng(12)
    more = Sweeps.of_um_rad(
        *(part[:3] for part in (rng.uniform(-HIGH, HIGH, (6, 6)), rng.uniform(-HIGH, HIGH, (6, 6))))
    )
    more = replace(more, session=np.full(3, "s4"), time_h=np.full(3, 8.0)).with_measurement(np.full(3, 0.1), SIGMA)
    more = more.with_measurement(MODEL.predict(followed.estimate().values, MODEL.rows(more.q_start, more.q_end)), SIGMA)
    later = join([sweeps, more])
    again, anew = (track(CELL, later, drift=DRIFT, known=known) for known in (taken_up, None))
    np.testing.assert_allclose(again.last.state.mean, anew.last.state.mean, atol=1e-6)
    np.testing.assert_allclose(again.last.nis, anew.last.nis, rtol=1e-6)


def test_out_of_reach_is_said_with_the_least_that_can_be_met(followed, sweeps):
    found = decide_track(followed, sweeps, Goal(2.0), Costs(), 10.0)
    assert found.action == "hold"
    assert re.search(r"2 nm cannot be met for circle: the best .* is \d+\.\d nm", found.reason)
    least = found.attainable_nm
    assert least > 20.0
    within = decide_track(followed, sweeps, Goal(least), Costs(), 10.0)
    assert within.action == "extrinsic"
    assert within.after.exceeds(1e-3 * least) <= 0.1


def test_where_one_session_is_not_enough_the_first_of_several_is_asked_for(machine):
    full = session("full", 0.0, paper_protocol(CELL, midpoints=True), machine)
    sweeps, goal, costs, left = full, Goal(36.0), Costs(), []
    while left[-1:] != [1]:
        now_h = 0.1 * (1 + len(left))
        found = decide_track(track(CELL, sweeps, drift=DRIFT), sweeps, goal, costs, now_h)
        assert found.action == "extrinsic"
        enough, said = found.after.exceeds(0.036) <= goal.level, re.search(r"(\d+) in a row do", found.reason)
        assert enough == (said is None)
        left.append(1 if said is None else int(said[1]))
        sweeps = join([sweeps, session(f"s{len(left)}", now_h, found.sweeps, machine)])
    assert 3 <= left[0] <= 5
    assert left == sorted(left, reverse=True)
    assert len(left) <= left[0] + 1


def test_compensation_leaves_less_to_hold(followed, sweeps):
    least = {}
    for compensate in (True, False):
        goal = Goal(2.0, ("tilt-x", "spin"), compensate=compensate)
        least[compensate] = decide_track(followed, sweeps, goal, Costs(), 10.0).attainable_nm
    assert least[True] < 0.9 * least[False]
