"""Readings of simulated traces: errors against stated uncertainty, counts, reversals, refusals, signs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from trace_fixtures import irradiance, record

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.fringes.count import Reading, SignSource, decide
from fpcal_bayes.fringes.fit import CALM, fit_course
from fpcal_bayes.fringes.profile import (
    DisplacementProfile,
    end_weights,
    estimated_profiles,
    legendre,
    lengths_at,
    prior_profiles,
)
from fpcal_bayes.fringes.reader import Recorded, estimate_sign_source, read_traces
from fpcal_bayes.fringes.samples import Samples, fault, lay_out
from fpcal_bayes.fringes.search import find_profiles
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.traces import Trace
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate

LIGHT = 1.56
PHASE = 4.0 * np.pi / LIGHT


@pytest.fixture(scope="module")
def plan(femto: Cell) -> Sweeps:
    return paper_protocol(femto)


@pytest.fixture(scope="module")
def truth(femto: Cell) -> Truth:
    return paper_truth(femto)


@pytest.fixture(scope="module")
def profiles(femto: Cell, plan: Sweeps) -> list[DisplacementProfile]:
    return prior_profiles(femto, plan)


def laid(
    sweeps: Sweeps, row: int, trace: Trace, profile: DisplacementProfile, sign_sources: tuple[SignSource, ...] = ()
) -> Recorded:
    joint = int(np.argmax(sweeps.q_start[row] != sweeps.q_end[row]))
    start, end = sweeps.q_start[row, joint], sweeps.q_end[row, joint]
    samples = lay_out(trace, start, end, unit="um", scale=1.0, place="trace")
    return Recorded(str(sweeps.label[row]), samples, start, end, profile, LIGHT, sign_sources=sign_sources)


def plain(profile: np.ndarray, n: int, seed: int = 0, noise: float = 0.01) -> Samples:
    """Samples of a profile given by its coefficients, from the simulator of `trace_fixtures`."""
    random, s = np.random.default_rng(seed), np.linspace(-1.0, 1.0, n)
    phase = PHASE * (legendre(s)[:, 1:] @ profile) + random.uniform(0.0, 6.28)
    return Samples(s, s, irradiance(random, phase, (s + 1) / 2, noise=noise), np.ones(n))


def free(slope_sd: float = 10.0, bend_sd: float = 1.0) -> DisplacementProfile:
    """A prior that knows next to nothing of slope and bend."""
    return DisplacementProfile(np.zeros(6), np.diag([slope_sd**2, bend_sd**2, 0.0, 0.0, 0.0, 0.0]))


def test_readings_err_as_they_say(femto: Cell, plan: Sweeps, truth: Truth, profiles: list[DisplacementProfile]) -> None:
    """Two campaigns of the whole protocol, other truths than the prior's middle, 4 to 40 samples a fringe."""
    model = CavityModel.of(femto, truth.parameters)
    sds = np.array([p.prior_sd for p in truth.parameters])
    scores, errors, lost, short = [], [], 0, 0
    for seed in range(2):
        random = np.random.default_rng(seed)
        values = truth.at(0.0) + 0.4 * sds * random.normal(size=len(sds))
        dl = model.predict(values, model.rows(plan.q_start, plan.q_end))
        density = np.exp(random.uniform(np.log(4.0), np.log(40.0), len(plan)))
        traces = [record(femto, model, values, plan.take(np.array([i])), random, density[i]) for i in range(len(plan))]
        readings = read_traces([laid(plan, i, t, profiles[i]) for i, t in enumerate(traces)], noise=0.01)
        for reading, true in zip(readings, dl, strict=True):
            error = reading.dl - true if reading.signed else abs(reading.dl) - abs(true)
            if not reading.fringes >= 3.0:
                short += 1
                assert not reading.good or abs(error) < 5.0 * reading.sigma
            elif not reading.good:
                lost += 1
            else:
                errors.append(error)
                scores.append(error / reading.sigma)
    assert short < 40
    assert lost <= 2
    assert np.sqrt(np.mean(np.square(errors))) < 2e-3
    # 95 % limits of a mean square over about 110 scores.
    assert 0.73 < np.mean(np.square(scores)) < 1.3
    assert np.abs(errors).max() < 0.02


def test_the_course_and_not_the_count_tells_a_reversal() -> None:
    """L rises by nine fringes and falls by five: counting tops would give fourteen."""
    bow = np.array([1.56, -3.51, 0.0, 0.0, 0.0, 0.0])
    reading = one(plain(bow, 900), free(bend_sd=5.0))
    assert reading.good
    assert abs(reading.dl) == pytest.approx(3.12, abs=4 * reading.sigma)
    lengths = legendre(np.linspace(-1.0, 1.0, 1001))[:, 1:] @ bow
    assert reading.fringes == pytest.approx(np.abs(np.diff(lengths)).sum() / 0.78, abs=0.02)
    turn = np.polynomial.legendre.Legendre([0.0, *bow]).deriv().roots()[0]
    assert reading.turns == pytest.approx((turn,), abs=5e-3)


def one(
    samples: Samples, profile: DisplacementProfile, sign_sources: tuple[SignSource, ...] = (), **options: float
) -> Reading:
    each = Recorded("sweep", samples, -1.0, 1.0, profile, LIGHT, sign_sources=sign_sources)
    return read_traces([each], noise=0.01, **options)[0]


def test_the_true_course_is_among_those_found() -> None:
    random = np.random.default_rng(5)
    for n in (40, 400, 4000):
        profile = np.array([random.uniform(1.0, n / 30), random.normal(), 0.0, 0.0, 0.0, 0.0])
        found = find_profiles(plain(profile, n, seed=n), free(), PHASE)
        assert min(min(np.abs(f - profile).max(), np.abs(f + profile).max()) for f in found) < 0.12


def test_the_covariance_is_that_of_the_linearised_signal() -> None:
    """Against numerical derivatives of the fitted signal, for a calm trace with noise alone."""
    profile = np.array([4.0, 0.7, 0.0, 0.0, 0.0, 0.0])
    samples = plain(profile, 300)
    fit = fit_course(samples, free(), profile, PHASE, nuisance=CALM, noise=0.01)
    step = 1e-5

    def signal(unknowns: np.ndarray) -> np.ndarray:
        prior = free()
        # The modes of this prior are its axes, smallest first: bend, then slope.
        moved = np.zeros(6)
        moved[1], moved[0] = 1.3 * unknowns[-2], 1.3 * 10.0 * unknowns[-1]
        signs = np.sign(np.linalg.eigh(4.0 * prior.covariance)[1][[1, 0], [-2, -1]])
        moved[[1, 0]] *= signs
        return replace(fit, unknowns=unknowns, profile=moved).signal(samples.s, samples.time, PHASE)

    np.testing.assert_allclose(signal(fit.unknowns), fit.signal(samples.s, samples.time, PHASE), atol=1e-9)
    jacobian = np.column_stack(
        [(signal(fit.unknowns + d) - signal(fit.unknowns - d)) / (2 * step) for d in step * np.eye(len(fit.unknowns))]
    )
    amplitude = max(fit.amplitude, 0.5 * np.ptp(samples.signal))
    sds = [20.0 * amplitude, *(amplitude * np.array(CALM.offset)), 1.0, *CALM.gain, 1e-6]
    sds += [0.014, 0.014, 0.005, 0.005, 100.0, 1.0, 1.0]
    information = jacobian.T @ jacobian / 0.01**2 + np.diag(np.array(sds) ** -2.0)
    slope_sd = 13.0 * np.sqrt(np.linalg.inv(information)[-1, -1])
    # The prior of the amplitude scales with its first guess, hence not to the last digit.
    assert np.sqrt(fit.covariance[0, 0]) == pytest.approx(slope_sd, rel=1e-2)


def test_intermediate_points_carry_their_covariance() -> None:
    """Errors of middle and end over many noises, against the stated covariance; a group never claims more."""
    profile = np.array([3.0, 0.8, 0.0, 0.0, 0.0, 0.0])
    s = np.array([0.0, 1.0])
    true = (legendre(s) - legendre(np.array([-1.0])))[:, 1:] @ profile
    errors, stated = [], []
    for seed in range(40):
        reading = one(plain(profile, 80, seed), free())
        changes, covariance = reading.changes(s)
        errors.append(np.sign(changes[1]) * changes - true)
        stated.append(covariance)
        _, grouped, sigma = reading.grouped(1)
        np.testing.assert_array_equal(grouped, changes)
        assert np.linalg.eigvalsh(sigma**2 * np.array([[1.0, 0.5], [0.5, 1.0]]) - covariance)[0] > -1e-12
    white = np.array([np.linalg.solve(np.linalg.cholesky(c), e) for c, e in zip(stated, errors, strict=True)])
    assert 0.75 < np.mean(white**2) < 1.3
    assert abs(np.mean(white[:, 0] * white[:, 1])) < 0.4


def test_a_witness_tells_the_sign_and_the_priors_do_where_they_are_sure() -> None:
    profile = np.array([-3.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    samples = plain(profile, 300)
    assert not one(samples, free()).signed
    told = one(samples, free(), (SignSource(-5.9, 0.1, "scans"),))
    assert told.signed
    assert told.sign_source == "scans"
    assert told.dl == pytest.approx(-6.0, abs=5 * told.sigma)
    assert np.sign(told.profile[0]) == -1
    sure = DisplacementProfile(np.array([-2.9, 0, 0, 0, 0, 0]), np.diag([0.04, 1.0, 0, 0, 0, 0]))
    assert one(samples, sure).sign_source == "prior"
    assert not one(samples, free(), (SignSource(1.0, 20.0, "estimate"),)).signed
    # A sign_source that contradicts the trace by far tells nothing.
    assert not one(samples, free(), (SignSource(-60.0, 0.1, "scans"),)).signed


def test_two_counts_that_fit_alike_are_doubtful_until_a_witness_decides() -> None:
    profile = np.array([3.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    fit = fit_course(plain(profile, 300), free(), profile, PHASE, nuisance=CALM, noise=0.01)
    other = replace(fit, profile=profile + np.array([0.39, 0, 0, 0, 0, 0]), evidence=fit.evidence - 3.0)
    verdict = decide([fit, other], [])
    assert verdict.doubtful
    assert verdict.other_counts == pytest.approx(np.exp(-3) / (1 + np.exp(-3)), rel=1e-6)
    assert verdict.alternatives == pytest.approx((6.78,), abs=1e-6)
    settled = decide([fit, other], [SignSource(6.7, 0.05, "estimate")])
    assert settled.fit is other
    assert not settled.doubtful
    assert settled.signed


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda y: np.minimum(y, np.quantile(y, 0.8)), "saturated: .* stand at the top"),
        (lambda y: np.maximum(y, np.quantile(y, 0.2)), "saturated: .* stand at the bottom"),
        (lambda y: np.full_like(y, 1.5), "the signal is constant"),
        (lambda y: 1.5 + 0.01 * np.random.default_rng(0).normal(size=len(y)), "no fringes are seen"),
    ],
)
def test_signals_that_tell_nothing_are_refused(spoil, why: str) -> None:  # type: ignore[no-untyped-def]
    samples = plain(np.array([5.0, 0.5, 0, 0, 0, 0]), 1000)
    reading = one(replace(samples, signal=spoil(samples.signal)), free())
    assert not reading.good
    assert np.isnan(reading.dl)
    assert re.search(why, reading.refused)


def test_the_full_scale_a_gap_and_few_samples_are_refused() -> None:
    samples = plain(np.array([5.0, 0.5, 0, 0, 0, 0]), 1000)
    assert "full scale" in one(samples, free(), full_scale=2.4).refused
    kept = np.abs(samples.s - 0.2) > 0.06
    holed = Samples(*(values[kept] for values in (samples.s, samples.time, samples.signal, samples.count)))
    assert "a gap: no samples over 6" in fault(holed)
    few = Samples(*(values[:6] for values in (samples.s, samples.time, samples.signal, samples.count)))
    assert "6 samples" in fault(few)
    assert fault(samples) == ""


def test_sparse_traces_are_refused_and_not_guessed() -> None:
    profile = np.array([7.8, 0.0, 0.0, 0.0, 0.0, 0.0])
    prior = DisplacementProfile(profile, np.diag([4.0, 0.04, 0, 0, 0, 0]))
    assert one(plain(profile, 85), prior).good
    assert "sparse" in one(plain(profile, 50), prior).refused
    # 1.4 samples a fringe look like many; the prior knows better.
    sure = DisplacementProfile(profile, np.diag([0.01, 0.0, 0, 0, 0, 0]))
    assert "by the cell's priors" in one(plain(profile, 28), sure).refused


def test_a_slip_and_a_short_sweep_are_doubtful() -> None:
    whole = [plain(np.array([5.0, 0.3, 0, 0, 0, 0]), 1000, seed) for seed in range(6)]
    slipped = whole[0].signal.copy()
    slipped[500:] = np.roll(slipped, 15)[500:]
    whole.append(replace(whole[0], signal=slipped))
    whole.append(plain(np.array([0.13, 0.02, 0, 0, 0, 0]), 300))
    readings = read_traces([Recorded("", w, -1.0, 1.0, free(), LIGHT) for w in whole], noise=0.01)
    assert all(reading.good for reading in readings[:6])
    assert "does not follow a smooth sweep" in readings[6].doubt
    assert "too few fringes" in readings[7].doubt or readings[7].refused
    assert "does not follow a smooth sweep" in one(whole[6], free()).doubt


def test_a_trace_of_another_sweep_is_refused() -> None:
    trace = Trace(np.arange(50.0), np.linspace(-3.0, 3.0, 50), np.zeros(50), "x.csv")
    for start, end, expected in (
        (-2.0, 3.0, r"x\.csv: column joint: the start at -3 deg disagrees with the index, expected -2 deg"),
        (-3.0, 2.0, r"x\.csv: column joint: the end at 3 deg disagrees with the index, expected 2 deg"),
        (3.0, -3.0, "the start at -3 deg"),
    ):
        with pytest.raises(InputError, match=expected):
            lay_out(trace, start, end, unit="deg", scale=1.0, place="")
    out = replace(trace, joint=np.where(np.arange(50) == 20, 9.0, trace.joint))
    with pytest.raises(InputError, match="9 deg lies outside the sweep of the index"):
        lay_out(out, -3.0, 3.0, unit="deg", scale=1.0, place="")


def test_bins_average_place_time_and_signal() -> None:
    samples = plain(np.array([1.0, 0, 0, 0, 0, 0]), 1000)
    few = samples.binned(100)
    assert len(few) == 100
    assert few.count.sum() == 1000
    for name in ("s", "time", "signal"):
        assert few.count @ getattr(few, name) == pytest.approx(getattr(samples, name).sum(), abs=1e-9)
    assert samples.binned(900) is samples


def test_courses_by_an_estimate_are_those_of_the_model(femto: Cell, plan: Sweeps, truth: Truth) -> None:
    values = truth.at(0.0)
    covariance = np.diag(np.full(len(values), 1e-8))
    status = tuple("identified" for _ in values)
    estimate = Estimate(femto, truth.parameters, values, covariance, status)
    model = CavityModel.of(femto, truth.parameters)
    dl, jacobian = model.predict_with_jacobian(values, model.rows(plan.q_start, plan.q_end))
    profiles = estimated_profiles(estimate, plan)
    np.testing.assert_allclose([profile.dl for profile in profiles], dl, atol=1e-5)
    np.testing.assert_allclose(
        [profile.dl_sd for profile in profiles], 1e-4 * np.linalg.norm(jacobian, axis=1), rtol=1e-3
    )
    assert estimate_sign_source(profiles[0]).sd > 2.0 * profiles[0].dl_sd


def test_six_polynomials_hold_every_sweep_of_the_protocol(femto: Cell, plan: Sweeps, truth: Truth) -> None:
    model = CavityModel.of(femto, truth.parameters)
    s = np.linspace(-1.0, 1.0, 41)
    for row in range(len(plan)):
        middle, half = (plan.q_start[row] + plan.q_end[row]) / 2, (plan.q_end[row] - plan.q_start[row]) / 2
        lengths = model.predict(truth.at(0.0), model.pose_rows(middle + s[:, None] * half))
        basis = legendre(s)
        left = lengths - basis @ np.linalg.lstsq(basis, lengths, rcond=None)[0]
        assert np.abs(left).max() < 1e-4
    assert end_weights() @ np.array([1.0, 5.0, 2.0, 5.0, 0.5, 5.0]) == pytest.approx(7.0)


def test_an_average_over_a_part_of_a_fringe_is_lower_where_the_mirror_moves() -> None:
    """Ten averages a fringe of a mirror that stands and then moves: without their spread the fit is 10 times worse."""
    s = np.linspace(-1.0, 1.0, 6000)
    there = np.maximum(s, -0.8)
    course = np.array([7.8, 0.3, 0.0, 0.0, 0.0, 0.0])
    signal = 2.0 + np.cos(PHASE * lengths_at(course, there) + 0.4)
    averaged = Samples(there, s, signal, np.ones(6000)).summed(
        lambda values: [np.add.reduceat(each, np.arange(0, 6000, 30)) for each in values]
    )
    prior = DisplacementProfile(course, np.diag([1e-2, 1e-2, 1e-6, 0.0, 0.0, 0.0]))
    errors = []
    for samples in (averaged, replace(averaged, spread=0.0)):
        fit = fit_course(samples, prior, course, PHASE, nuisance=CALM, noise=1e-3)
        errors.append(np.abs(fit.signal(samples.s, samples.time, PHASE, samples.spread) - samples.signal).max())
    assert errors[0] < 1e-3
    assert errors[1] > 10.0 * errors[0]
