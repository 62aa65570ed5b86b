"""The fit of the irradiance itself: right, and as much better than end points as it says."""

from dataclasses import replace

import numpy as np
import pytest

from fpcal_bayes.analysis.traces import identify_traces
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.traces.fit import fit_traces
from fpcal_bayes.infer.traces.kernels import trace_grams
from fpcal_bayes.infer.traces.samples import NODES, TraceSamples
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol, single_sweep
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.simulator.optics import HARD, RecorderSettings
from fpcal_bayes.simulator.recorder import record_sweeps
from fpcal_bayes.simulator.sweeps import noise_free, simulate_um

#: A tenth of the default rate: still more than three samples a fringe.
SHORT = RecorderSettings(rate_hz=20.0)


@pytest.fixture(scope="module")
def ends(femto: Cell) -> Estimate:
    return identify(femto, simulate_um(femto, paper_truth(femto), paper_protocol(femto), sigma=0.005, seed=0)).estimate


def sd_of(estimate: Estimate, name: str) -> float:
    return float(estimate.sd[estimate.parameters.position(name)])


def scores(cell: Cell, estimate: Estimate) -> np.ndarray:
    """Errors of the sweeps' changes of length in units of their stated standard deviation."""
    model, plan = CavityModel.of(cell), paper_protocol(cell)
    rows = model.rows(plan.q_start, plan.q_end)
    predicted, jacobian = model.predict_with_jacobian(estimate.values, rows)
    sd = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, estimate.covariance, jacobian))
    return (predicted - noise_free(cell, paper_truth(cell), plan)) / sd


def test_whole_traces_tell_more_than_end_points(femto: Cell, ends: Estimate) -> None:
    """Noise of 5 nm on each of 40 points: five times closer and more (studies/whole_traces.py), rank 17."""
    quiet = replace(femto, optics=replace(femto.interferometer, noise=5e-4))
    settings = RecorderSettings(rate_hz=4.0, length_noise=0.005)
    index = record_sweeps(quiet, paper_truth(femto), paper_protocol(femto), settings, scans=False)
    fit = fit_traces(quiet, index, ends, length_noise=0.005)
    assert fit.converged
    assert fit.rank == 17
    assert not fit.warnings
    assert 5.0 * sd_of(fit.estimate, "z_et") < sd_of(ends, "z_et")
    truth = paper_truth(femto).values[0][fit.estimate.parameters.position("z_et")]
    error = fit.estimate.values[fit.estimate.parameters.position("z_et")] - truth
    assert abs(error) < 4 * sd_of(fit.estimate, "z_et")


@pytest.mark.parametrize("settings", [SHORT, replace(HARD, rate_hz=20.0)])
def test_stated_sd_holds_with_the_photodiodes_noise(femto: Cell, ends: Estimate, settings: RecorderSettings) -> None:
    index = record_sweeps(femto, paper_truth(femto), paper_protocol(femto), settings, seed=1, scans=False)
    fit = fit_traces(femto, index, ends)
    assert fit.converged
    # 69 changes of length that depend on 17 directions: 99.9 % of chi-square over 17 lies below 2.4.
    assert np.mean(scores(femto, fit.estimate) ** 2) < 2.4
    noise = femto.interferometer.noise if settings.noise is None else settings.noise * np.abs(fit.levels[:, 3])
    assert np.median(fit.residual / noise) == pytest.approx(1.0, abs=0.05)
    assert fit.content()["fit"]["converged"]


def test_extrinsic_parameters_alone(femto: Cell, ends: Estimate) -> None:
    index = record_sweeps(femto, paper_truth(femto), paper_protocol(femto), SHORT, scans=False)
    fit = fit_traces(femto, index, ends, free="extrinsic", prior=ends)
    assert fit.estimate.parameters.names == femto.select("extrinsic").names
    assert fit.converged


def test_an_estimate_off_by_fringes_is_told(femto: Cell, ends: Estimate) -> None:
    away = ends.values.copy()
    away[ends.parameters.position("beta_et")] += np.radians(3.0)
    index = record_sweeps(femto, paper_truth(femto), paper_protocol(femto), SHORT, scans=False)
    fit = fit_traces(femto, index, replace(ends, values=away), max_steps=8)
    assert not fit.converged
    assert any("worse than 3 times the photodiode's noise" in warning for warning in fit.warnings)


def test_kernel_derivatives_agree_with_differences() -> None:
    """Inner products of the columns against those of columns by central differences."""
    random = np.random.default_rng(3)
    n, series, levels = 40, random.normal(size=(1, 5)), random.normal(size=(1, 10))
    first, place, time = np.array([0, n]), random.uniform(-1, 1, n), np.linspace(-1, 1, n)
    envelope, wave_number = random.uniform(0.5, 1.0, n), np.array([2.0])

    def model(c: np.ndarray, p: np.ndarray) -> np.ndarray:
        length = np.polynomial.chebyshev.chebval(place, [0.0, *c])
        phase = wave_number[0] * length + p[9]
        powers = time[:, None] ** np.arange(3)
        harmonic = p[7] * np.cos(2 * phase) + p[8] * np.sin(2 * phase)
        return powers @ p[:3] + p[6] * envelope**2 + envelope * (powers @ p[3:6] * np.cos(phase) + harmonic)

    irradiance = model(series[0], levels[0]) + 0.1 * random.normal(size=n)
    gram, squares = trace_grams(
        first, place, time, envelope, irradiance, series, levels, wave_number, np.array([0.5]), 0.0
    )
    at, step = np.concatenate([series[0], levels[0]]), 1e-6
    columns = []
    for i in range(15):
        shift = np.zeros(15)
        shift[i] = step
        ahead, behind = (model((at + s)[:5], (at + s)[5:]) for s in (shift, -shift))
        columns.append((ahead - behind) / (2 * step))
    columns.append(irradiance - model(series[0], levels[0]))
    stacked = np.column_stack(columns)
    np.testing.assert_allclose(gram[0], stacked.T @ stacked / 0.25, rtol=1e-6, atol=1e-6)
    assert squares[0] == pytest.approx(columns[-1] @ columns[-1])


def test_series_meet_the_lengths(femto: Cell) -> None:
    truth, plan = paper_truth(femto), paper_protocol(femto).take(np.array([3, 5, 50]))
    model, values = CavityModel.of(femto), paper_truth(femto).values[0]
    index = record_sweeps(femto, truth, plan, SHORT, scans=False)
    samples = TraceSamples.of(model, values, index)
    series, slopes = samples.series(model, values, samples.rows(model))
    assert slopes.shape == (3, NODES - 1, len(femto.free))
    for i, trace in enumerate(index.traces):
        q = np.repeat(plan.q_start[i : i + 1], len(trace), axis=0)
        q[:, int(np.argmax(plan.q_start[i] != plan.q_end[i]))] = trace.joint
        exact = model.predict(values, model.pose_rows(q))
        place = samples.place[samples.first[i] : samples.first[i + 1]]
        found = np.polynomial.chebyshev.chebval(place, [0.0, *series[i]])
        np.testing.assert_allclose(found - found[0], exact - exact[0], atol=1e-9)


def test_bad_input_is_refused(femto: Cell, ends: Estimate) -> None:
    truth, plan = paper_truth(femto), single_sweep(femto, 3, -10.0, 10.0)
    index = record_sweeps(femto, truth, plan, SHORT, scans=False)
    still = replace(index.traces[0], joint=np.zeros(len(index.traces[0])))
    with pytest.raises(InputError, match="the joint does not move"):
        fit_traces(femto, replace(index, traces=[still]), ends)
    brief = replace(index.traces[0], **{k: getattr(index.traces[0], k)[:12] for k in ("time_s", "joint", "irradiance")})
    with pytest.raises(InputError, match="12 samples are too few"):
        fit_traces(femto, replace(index, traces=[brief]), ends)
    absolute = replace(index, sweeps=replace(plan, kind=np.array(["absolute"])))
    with pytest.raises(InputError, match="no sweep with a trace"):
        fit_traces(femto, absolute, ends)


def test_whole_traces_start_from_their_own_ends_and_name_what_they_leave_out(femto: Cell) -> None:
    """A truth drawn from the prior: 99.9 % of the mean square of 21 standardised errors lies below 2.3."""
    paper, random = paper_truth(femto), np.random.default_rng(1003)
    sds = np.array([p.prior_sd for p in paper.parameters])
    truth = replace(paper, times_h=np.zeros(1), values=(femto.free.nominal + 0.5 * sds * random.normal(size=21))[None])
    plan = paper_protocol(femto)
    index = record_sweeps(femto, truth, plan, SHORT, seed=3, scans=False)
    late = index.traces[46]
    held = late.irradiance.copy()
    held[:20] = held[20]
    traces = [*index.traces[:46], replace(late, irradiance=held), *index.traces[47:]]
    fit = identify_traces(femto, replace(index, traces=traces))
    assert fit.converged
    assert np.mean(((fit.estimate.values - truth.values[0]) / fit.estimate.sd) ** 2) < 2.3
    assert plan.label[46] not in fit.labels
    assert any(str(plan.label[46]) in warning for warning in fit.warnings)


def test_whole_traces_refuse_error_motions() -> None:
    cell = load_cell()
    index = record_sweeps(cell, paper_truth(cell), single_sweep(cell, 3, -10.0, 10.0), SHORT, scans=False)
    with pytest.raises(InputError, match="states error motions"):
        identify_traces(cell, index)
