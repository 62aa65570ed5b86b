"""Whole traces as rows: right, and as much better than end points as they say."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.analysis.traces import trace_rows
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.fringes.fit import CALM, fit_course
from fpcal_bayes.fringes.ingest import ingest
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, lengths_at
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.minimise import minimise
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.optics import RecorderSettings
from fpcal_bayes.simulator.recorder import record_sweeps
from fpcal_bayes.simulator.sweeps import simulate_um

sys.path.insert(0, str(Path(__file__).parents[1] / "studies"))
from whole_traces import FromTruth

#: A tenth of the default rate: still more than three samples a fringe.
SHORT = RecorderSettings(rate_hz=20.0)
PHASE = 4.0 * np.pi / 1.56


def test_whole_traces_tell_more_than_end_points(femto: Cell) -> None:
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
    rows, warnings = trace_rows(femto, replace(index, traces=traces))
    found = identify(femto, rows)
    assert found.converged
    assert found.spectrum.rank == 17
    assert found.fit.p_value > 1e-3
    assert np.mean(((found.estimate.values - truth.values[0]) / found.estimate.sd) ** 2) < 2.3
    # A trace that is left out is named.
    assert plan.label[46] not in rows.group
    assert any(str(plan.label[46]) in warning for warning in warnings)
    at = found.estimate.parameters.position("z_et")
    ends = identify(femto, simulate_um(femto, truth, plan, sigma=0.005, seed=0)).estimate
    assert 20.0 * found.estimate.sd[at] < ends.sd[at]
    # Rows that share errors stand beside others, and are not packed as if they did not.
    both = join([rows, simulate_um(femto, truth, plan, sigma=0.005, seed=1)])
    assert both.common.shape == (len(both), DEGREE)
    assert not both.common[len(rows) :].any()
    assert found.content()["rows"] is None


def test_rows_of_whole_traces_are_as_far_from_the_truth_as_they_say(femto: Cell) -> None:
    """The way from the truth on ends where the long one does; 99.9 % of the mean squares of 190 rows lie below 1.35."""
    paper, plan = paper_truth(femto), paper_protocol(femto)
    sds = np.array([p.prior_sd for p in paper.parameters])
    drawn = femto.free.nominal + sds * np.random.default_rng(2).standard_normal(21)
    index = record_sweeps(femto, replace(paper, times_h=np.zeros(1), values=drawn[None]), plan, SHORT, seed=2)
    fast = FromTruth(femto, plan)
    problem = Problem.of(fast.model, fast.rows(index, drawn))
    squares = problem.data_residuals(problem.unknowns(drawn)) ** 2
    assert 0.6 < squares.mean() < 1.35
    found = problem.values(minimise(problem, problem.unknowns(drawn)).unknowns)
    rows, said = trace_rows(femto, index)
    long = identify(femto, rows)
    assert np.all(np.abs(found - long.estimate.values) < 0.3 * long.estimate.sd)
    # One trace is too short to follow: the scans at its ends tell its change, as a row of its own.
    alone = np.flatnonzero(rows.group == "")
    assert len(problem.target) == len(rows) - 1
    assert any("by their scans alone" in text and str(rows.label[alone[0]]) in text for text in said)
    true = fast.model.predict(drawn, rows.take(alone).laid_out(fast.model))
    assert rows.signed[alone].all()
    assert np.all(np.abs(rows.dl[alone] - true) < 4.0 * rows.sigma[alone])
    assert np.all(rows.sigma[alone] < 0.2)


def test_half_a_turn_is_followed_though_one_trace_alone_looks_uneven(femto: Cell) -> None:
    """q6 from 90 to -90 deg moves L by polynomials that the reader lacks; a mirror off its course is left out."""
    paper, few = paper_truth(femto), paper_protocol(femto).take(np.arange(0, 69, 3))
    sds = np.array([p.prior_sd for p in paper.parameters])
    drawn = femto.free.nominal + sds * np.random.default_rng(14).standard_normal(21)
    q = np.array([150.0, 150.0, 150.0, 0.065, -0.038, np.pi / 2.0])
    turn = replace(
        few.take(np.array([0])), q_start=q[None], q_end=(q * [1, 1, 1, 1, 1, -1])[None], label=np.array(["turn"])
    )
    plan = join([few, turn])
    index = record_sweeps(femto, replace(paper, times_h=np.zeros(1), values=drawn[None]), plan, seed=14)
    assert [reading.uneven for reading in ingest(index, femto).readings if reading is not None][-1]
    rows, _ = trace_rows(femto, index)
    own = rows.group == "turn"
    assert own.sum() >= 4
    model = CavityModel.of(femto)
    problem = Problem.of(model, rows.take(own))
    assert np.mean(problem.data_residuals(problem.unknowns(drawn)) ** 2) < 3.0
    # The same light, of a mirror that lags behind by up to 20 nm on its way.
    trace = index.traces[-1]
    joint = trace.joint + 3e-4 * np.sin(np.linspace(0.0, 4.0 * np.pi, len(trace)))
    rows, said = trace_rows(femto, replace(index, traces=[*index.traces[:-1], replace(trace, joint=joint)]))
    assert "turn" not in rows.group
    assert any("turn" in text for text in said)


def test_what_a_signal_tells_does_not_depend_on_its_prior() -> None:
    """The same signal under a prior at the truth and under one that is ten sd away: the same changes, the same root."""
    random, s = np.random.default_rng(5), np.linspace(-1.0, 1.0, 1500)
    course = np.array([9.0, 0.4, 0, 0, 0, 0])
    signal = 2.0 + np.cos(PHASE * lengths_at(course, s) + 0.3) + 0.01 * random.standard_normal(1500)
    samples, places = Samples(s, s, signal, np.ones(1500)), np.array([-0.2, 1.0])
    told = []
    for mean in (course, course + np.array([0.01, -0.01, 0, 0, 0, 0])):
        prior = DisplacementProfile(mean, np.diag([1e-6, 1e-6, 0, 0, 0, 0]))
        fit = fit_course(samples, prior, mean, PHASE, nuisance=CALM, noise=0.01)
        changes, root = fit.told(places)
        told.append((changes, root @ root.T))
    true = lengths_at(course, places) - lengths_at(course, np.array([-1.0]))
    np.testing.assert_allclose(told[0][0], told[1][0], atol=2e-5)
    np.testing.assert_allclose(told[0][1], told[1][1], rtol=1e-2)
    assert np.all(np.abs(told[0][0] - true) < 4.0 * np.sqrt(np.diag(told[0][1])))


def test_no_trace_that_can_be_used_is_said(femto: Cell) -> None:
    plan = paper_protocol(femto).take(np.array([46, 49]))
    index = record_sweeps(femto, paper_truth(femto), plan, SHORT, scans=False)
    dark = [replace(trace, irradiance=np.full(len(trace), 1.0)) for trace in index.traces]
    with pytest.raises(InputError, match="no sweep can be used"):
        trace_rows(femto, replace(index, traces=dark))


@pytest.mark.parametrize("degrees", [0.2, 5.0])
def test_what_only_an_expectation_says_of_a_trace_is_not_taken(femto: Cell, degrees: float) -> None:
    """Another sweep foresees neither a change of less than a fringe, 0.4 um +- 0.7, nor the sign of a large one."""
    plan, tilt = paper_protocol(femto).take(np.array([46, 49])), np.zeros(6)
    tilt[3] = np.deg2rad(degrees)
    plan = replace(plan, q_start=np.vstack([plan.q_start[:1], 0.0 * tilt]), q_end=np.vstack([plan.q_end[:1], tilt]))
    rows, warnings = trace_rows(femto, record_sweeps(femto, paper_truth(femto), plan, SHORT, seed=1, scans=False))
    if degrees < 1.0:
        assert set(rows.group) == {plan.label[0]}
        assert any(str(plan.label[1]) in warning for warning in warnings)
    else:
        tilted = rows.group == plan.label[1]
        assert tilted.any()
        assert not rows.signed[tilted].any()
        assert (rows.dl[tilted] > 0.0).all()
