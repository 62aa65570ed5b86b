"""The filter against exact joint conditioning, statsmodels and its own invariants."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from statsmodels.tsa.statespace.mlemodel import MLEModel
from track_fixtures import CELL, DRIFT, SIGMA, campaign

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.drift_sizes import DriftSize
from fpcal_bayes.tracking import measurement as rows_taken_in
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.filter import inflate, predict, update
from fpcal_bayes.tracking.measurement import LinearMeasurement, SweepMeasurement, equivalent_rows
from fpcal_bayes.tracking.session import SessionOutcome
from fpcal_bayes.tracking.smoother import smooth

EXTRINSIC = CELL.select("extrinsic")
KNOWN = {"walk": 1.0, "rate_sd": 0.5, "bounded_sd": 0.7, "bounded_hours": 9.0, "temperature": 0.3}


def whitened(z, h, covariance):
    """Linear rows of any covariance."""
    factor = np.linalg.cholesky(covariance)
    rows = np.linalg.solve(factor, np.column_stack([z, h]))
    return LinearMeasurement(rows[:, 0], rows[:, 1:], -np.log(np.diag(factor)).sum())


def linear_case(seed: int, count: int = 7):
    """A drift with every part, times, temperatures and linear rows of varying number."""
    random = np.random.default_rng(seed)
    sizes = tuple(
        DriftSize(p.name, **{k: (v if k == "bounded_hours" else v * 0.01 * p.prior_sd) for k, v in KNOWN.items()})
        for p in EXTRINSIC
    )
    drift = DriftModel(EXTRINSIC, sizes)
    times, kelvin = np.cumsum(random.uniform(0.5, 20.0, count)), random.standard_normal(count)
    rows = []
    for _ in range(count):
        n = int(random.integers(1, 6))
        h = np.zeros((n, drift.n_states))
        h[:, :8] = random.standard_normal((n, 8)) * 30.0
        root = random.standard_normal((n, n)) + 2 * np.eye(n)
        rows.append((random.standard_normal(n) * 20.0, h, root @ root.T))
    mean = random.standard_normal(drift.n_states)
    root = random.standard_normal((drift.n_states, drift.n_states))
    start = State(0.0, mean, root @ root.T / drift.n_states + 0.1 * np.eye(drift.n_states), 20.0)
    return drift, start, times, 20.0 + np.cumsum(kelvin), rows


def run(drift, start, times, temperatures, rows):
    outcomes, total = [outcome_of(start, start, drift)], 0.0
    state = start
    for time, temperature, (z, h, r) in zip(times, temperatures, rows, strict=True):
        predicted = predict(drift, state, float(time), float(temperature))
        measurement = whitened(z, h, r)
        taken = update(predicted, measurement)
        state, total = taken.state, total + taken.innovation.log_likelihood
        outcomes.append(replace(outcome_of(predicted, state, drift), measurement=measurement))
    return outcomes, total


def outcome_of(predicted: State, state: State, drift: DriftModel) -> SessionOutcome:
    return SessionOutcome("s", state.time_h, "", predicted, state, np.zeros(drift.n_states), n_sweeps=1, dof=1)


def joint(drift, start, times, temperatures, rows):
    """Means and covariances of all states given all rows, by conditioning one joint Gaussian."""
    n, count = drift.n_states, len(times) + 1
    mean, covariance = [start.mean], np.zeros((n * count, n * count))
    covariance[:n, :n] = start.covariance
    before, warm = 0.0, start.temperature_c
    for k, (time, temperature) in enumerate(zip(times, temperatures, strict=True), 1):
        step = drift.transition(float(time - before), float(temperature - warm))
        before, warm = time, temperature
        mean.append(step.matrix @ mean[-1] + step.shift)
        new, old = slice(n * k, n * k + n), slice(n * k - n, n * k)
        covariance[new, : n * k] = step.matrix @ covariance[old, : n * k]
        covariance[: n * k, new] = covariance[new, : n * k].T
        covariance[new, new] = step.matrix @ covariance[old, old] @ step.matrix.T + step.noise
    stacked = np.concatenate(mean)
    h = np.zeros((sum(len(z) for z, _, _ in rows), n * count))
    r = np.zeros((len(h), len(h)))
    at = 0
    for k, (z, part, noise) in enumerate(rows, 1):
        h[at : at + len(z), n * k : n * k + n] = part
        r[at : at + len(z), at : at + len(z)] = noise
        at += len(z)
    z = np.concatenate([z for z, _, _ in rows])
    spread = h @ covariance @ h.T + r
    gain = np.linalg.solve(spread, h @ covariance).T
    misfit = z - h @ stacked
    _, log_det = np.linalg.slogdet(2 * np.pi * spread)
    log_likelihood = -0.5 * (misfit @ np.linalg.solve(spread, misfit) + log_det)
    after, left = stacked + gain @ misfit, covariance - gain @ h @ covariance
    blocks = [slice(n * k, n * k + n) for k in range(count)]
    return [after[b] for b in blocks], [left[b, b] for b in blocks], float(log_likelihood)


@pytest.mark.parametrize("seed", range(4))
def test_filter_and_smoother_equal_joint_conditioning(seed):
    case = linear_case(seed)
    outcomes, total = run(*case)
    means, covariances, log_likelihood = joint(*case)
    np.testing.assert_allclose(outcomes[-1].state.mean, means[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(outcomes[-1].state.covariance, covariances[-1], rtol=0, atol=1e-9)
    assert total == pytest.approx(log_likelihood, abs=1e-9 * abs(log_likelihood))
    for state, mean, covariance in zip(smooth(case[0], outcomes).states, means, covariances, strict=True):
        np.testing.assert_allclose(state.mean, mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(state.covariance, covariance, rtol=0, atol=1e-9)


def test_statsmodels_gives_the_same_likelihood():
    drift, start, times, temperatures, rows = linear_case(9)
    _, total = run(drift, start, times, temperatures, rows)
    n, count, widest = drift.n_states, len(times), max(len(z) for z, _, _ in rows)
    data = np.full((count, widest), np.nan)
    model = MLEModel(data, k_states=n, k_posdef=n)
    design, noise = np.zeros((widest, n, count)), np.tile(np.eye(widest)[:, :, None], count)
    matrix, state_noise, shift = np.zeros((n, n, count)), np.zeros((n, n, count)), np.zeros((n, count))
    before, warm = 0.0, start.temperature_c
    first = start.mean, start.covariance
    for k, (z, h, r) in enumerate(rows):
        data[k, : len(z)] = z
        design[: len(z), :, k], noise[: len(z), : len(z), k] = h, r
        step = drift.transition(float(times[k] - before), float(temperatures[k] - warm))
        before, warm = times[k], temperatures[k]
        # There, the transition of a time leads to the next one.
        if k:
            matrix[:, :, k - 1], state_noise[:, :, k - 1], shift[:, k - 1] = step.matrix, step.noise, step.shift
        else:
            first = step.matrix @ start.mean + step.shift, step.matrix @ start.covariance @ step.matrix.T + step.noise
    model = MLEModel(data, k_states=n, k_posdef=n)
    model["design"], model["obs_cov"], model["selection"] = design, noise, np.eye(n)
    model["transition"], model["state_cov"], model["state_intercept"] = matrix, state_noise, shift
    model.initialize_known(*first)
    assert model.ssm.loglike() == pytest.approx(total, rel=1e-9)


def test_ten_thousand_updates_leave_a_positive_definite_covariance():
    _, sweeps = campaign(0, sessions=1, count=6)
    model = CavityModel.of(CELL)
    found = identify(CELL, sweeps.of_session("day0")).estimate
    state = State(0.0, *DRIFT.initial(found.values, found.covariance))
    measurement = SweepMeasurement.of(DRIFT, model, sweeps.of_session("s1"), state.mean)
    misfit, jacobian = measurement.linearise(state.mean)
    rows = LinearMeasurement(misfit + jacobian @ state.mean, jacobian)
    for i in range(10_000):
        state = update(predict(DRIFT, state, 0.01 * (i + 1)), rows).state
    np.testing.assert_array_equal(state.covariance, state.covariance.T)
    sd = np.sqrt(np.diag(state.covariance))
    assert np.linalg.eigvalsh(state.covariance / np.outer(sd, sd))[0] > 0
    np.linalg.cholesky(state.covariance)


def test_an_update_is_the_maximum_of_state_and_rows():
    _, sweeps = campaign(3, sessions=1, count=6)
    found = identify(CELL, sweeps.of_session("day0")).estimate
    state = predict(DRIFT, State(0.0, *DRIFT.initial(found.values, found.covariance)), 8.0)
    measurement = SweepMeasurement.of(DRIFT, CavityModel.of(CELL), sweeps.of_session("s1"), state.mean)
    taken = update(state, measurement)
    assert taken.converged
    misfit, jacobian = measurement.linearise(taken.state.mean)
    pull = np.linalg.solve(state.covariance, taken.state.mean - state.mean)
    gradient = jacobian.T @ misfit - pull
    # In standard deviations of the result.
    assert np.sqrt(gradient @ taken.state.covariance @ gradient) < 0.01


def test_all_sweeps_at_once_or_one_by_one_is_the_same_where_rows_are_linear():
    _, start, _, _, rows = linear_case(5)
    z, h, r = rows[0]
    r = np.diag(np.diag(r))
    once = update(start, whitened(z, h, r))
    state, total = start, 0.0
    for i in range(len(z)):
        taken = update(state, whitened(z[i : i + 1], h[i : i + 1], r[i : i + 1, i : i + 1]))
        state, total = taken.state, total + taken.innovation.log_likelihood
    np.testing.assert_allclose(state.mean, once.state.mean, atol=1e-10)
    np.testing.assert_allclose(state.covariance, once.state.covariance, atol=1e-10)
    assert total == pytest.approx(once.innovation.log_likelihood, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 80), st.integers(1, 12), st.integers(0, 12), st.integers(0, 1000))
def test_equivalent_rows_say_the_same_about_the_state(n_rows, n_states, rank, seed):
    random = np.random.default_rng(seed)
    h = random.standard_normal((n_rows, min(rank, n_states))) @ random.standard_normal((min(rank, n_states), n_states))
    y = random.standard_normal(n_rows) * 10.0
    few, slope = equivalent_rows(y, h)
    if n_rows <= 2 * n_states:
        assert few is y
        assert slope is h
    else:
        assert slope.shape == (n_states + 1, n_states)
    np.testing.assert_allclose(slope.T @ slope, h.T @ h, atol=1e-11 * (1.0 + np.sum(h**2)))
    np.testing.assert_allclose(slope.T @ few, h.T @ y, atol=1e-10 * (1.0 + np.sum(h**2)))
    assert few @ few == pytest.approx(y @ y)


def test_many_rows_are_taken_in_exactly():
    """Against the conditional normal distribution, with its matrices of rows by rows."""
    random = np.random.default_rng(11)
    drift, start, _, _, _ = linear_case(7)
    n = drift.n_states
    h = np.zeros((150, n))
    h[:, :8] = random.standard_normal((150, 8)) * 30.0
    z = h @ start.mean + random.standard_normal(150) * 40.0
    r = np.diag(random.uniform(0.5, 2.0, 150))
    taken = update(start, whitened(z, h, r))
    spread = h @ start.covariance @ h.T + r
    gain = np.linalg.solve(spread, h @ start.covariance).T
    misfit = z - h @ start.mean
    np.testing.assert_allclose(taken.state.mean, start.mean + gain @ misfit, rtol=0, atol=1e-9)
    covariance = start.covariance - gain @ h @ start.covariance
    np.testing.assert_allclose(taken.state.covariance, covariance, rtol=0, atol=1e-9)
    innovation = taken.innovation
    assert (innovation.dof, len(innovation.misfit), len(taken.misfit)) == (150, n + 1, 150)
    assert innovation.squared == pytest.approx(misfit @ np.linalg.solve(spread, misfit), rel=1e-9)
    expected = stats.multivariate_normal(h @ start.mean, spread).logpdf(z)
    assert innovation.log_likelihood == pytest.approx(expected, rel=1e-9)
    wide = inflate(start, np.full(n, 0.5))
    again = update(wide, whitened(z, h, r)).innovation
    assert innovation.under(wide.covariance).log_likelihood == pytest.approx(again.log_likelihood, rel=1e-12)


def test_many_sweeps_are_taken_in_alike_both_ways(monkeypatch):
    _, sweeps = campaign(6, sessions=1, count=60)
    found = identify(CELL, sweeps.of_session("day0")).estimate
    state = predict(DRIFT, State(0.0, *DRIFT.initial(found.values, found.covariance)), 8.0)
    measurement = SweepMeasurement.of(DRIFT, CavityModel.of(CELL), sweeps.of_session("s1"), state.mean)
    few = update(state, measurement)
    monkeypatch.setattr(rows_taken_in, "_ROWS_PER_STATE", 1000)
    whole = update(state, measurement)
    assert (len(few.innovation.misfit), len(whole.innovation.misfit)) == (22, 60)
    np.testing.assert_allclose(few.state.mean, whole.state.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(few.state.covariance, whole.state.covariance, rtol=0, atol=1e-9)
    assert few.innovation.squared == pytest.approx(whole.innovation.squared, rel=1e-9)
    assert few.innovation.log_likelihood == pytest.approx(whole.innovation.log_likelihood, rel=1e-9)


def test_missing_sessions_need_nothing():
    state = linear_case(6)[1]
    drift = linear_case(6)[0]
    twice = predict(drift, predict(drift, state, 5.0), 30.0)
    once = predict(drift, state, 30.0)
    np.testing.assert_allclose(twice.mean, once.mean, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, once.covariance, atol=1e-12)


def test_a_jump_widens_what_it_names():
    wide = inflate(State(0.0, np.zeros(2), np.eye(2)), np.array([3.0, 0.0]))
    assert np.diag(wide.covariance).tolist() == [10.0, 1.0]


def test_rows_that_share_a_reading_are_whitened_together():
    from fpcal_bayes.measure.protocol import add_midpoints
    from fpcal_bayes.simulator.sweeps import simulate_um

    truth, sweeps = campaign(4, sessions=1, count=3)
    both = simulate_um(CELL, truth, add_midpoints(sweeps.of_session("s1")), sigma=SIGMA, seed=1)
    measurement = SweepMeasurement.of(DRIFT, CavityModel.of(CELL), both, DRIFT.initial(truth.at(8.0), np.eye(21))[0])
    covariance = np.kron(np.eye(3), SIGMA**2 * np.array([[1.0, 0.5], [0.5, 1.0]]))
    expected = -0.5 * np.linalg.slogdet(covariance)[1]
    assert measurement.log_volume == pytest.approx(expected)
    misfit = both.dl - measurement.predict(DRIFT.initial(truth.at(8.0), np.eye(21))[0])
    squared = measurement.misfit(DRIFT.initial(truth.at(8.0), np.eye(21))[0])
    assert squared @ squared == pytest.approx(misfit @ np.linalg.solve(covariance, misfit))
