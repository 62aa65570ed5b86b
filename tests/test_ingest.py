"""Recorded traces to sweeps: rows, groups, absolute lengths, doubtful ones, and the truth found again."""

from dataclasses import replace

import numpy as np
import pytest
from trace_fixtures import record_all, scan

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.fringes.ingest import IngestSettings, ingest
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.traces import Trace
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.simulator.recorder import record_sweeps
from fpcal_bayes.simulator.sweeps import noise_free


@pytest.fixture(scope="module")
def truth(femto: Cell) -> Truth:
    return paper_truth(femto)


@pytest.fixture(scope="module")
def campaign(femto: Cell, truth: Truth) -> TraceIndex:
    """The whole protocol at 12 samples a fringe."""
    model = CavityModel.of(femto, truth.parameters)
    return record_all(femto, model, truth.at(0.0), paper_protocol(femto), 7, 12.0)


@pytest.fixture(scope="module")
def near(femto: Cell, truth: Truth) -> Estimate:
    """An estimate near the truth, as a calibration leaves it."""
    values = truth.at(0.0)
    status = tuple("identified" for _ in values)
    return Estimate(femto, truth.parameters, values * (1 + 1e-6), np.diag((1e-6 * np.abs(values)) ** 2), status)


def picked(index: TraceIndex, rows: list[int]) -> TraceIndex:
    chosen = np.array(rows)
    arrays = {n: getattr(index, n)[chosen] for n in ("wavelength", "temperature_c", "pressure_hpa", "humidity_pct")}
    lists = {n: [getattr(index, n)[i] for i in rows] for n in ("traces", "scans_before", "scans_after")}
    return replace(index, sweeps=index.sweeps.take(chosen), **arrays, **lists)


def true_dl(femto: Cell, truth: Truth, index: TraceIndex) -> np.ndarray:
    model = CavityModel.of(femto, truth.parameters)
    return model.predict(truth.at(0.0), model.rows(index.sweeps.q_start, index.sweeps.q_end))


def test_a_campaign_recovers_the_truth(femto: Cell, truth: Truth, campaign: TraceIndex, near: Estimate) -> None:
    found = ingest(campaign, femto, estimate=near)
    assert found.sweeps.signed.all()
    assert len(found.sweeps) + len(found.doubtful) == 69
    assert len(found.doubtful) <= 3
    result = identify(femto, found.sweeps)
    assert result.converged
    deviations = (result.estimate.values - truth.at(0.0)) / result.estimate.sd
    assert np.abs(deviations).max() < 4.0
    assert result.fit.chi2_data < 1.6 * 53


def test_signs_come_from_scans_priors_and_estimates(
    femto: Cell, truth: Truth, campaign: TraceIndex, near: Estimate
) -> None:
    part = picked(campaign, [0, 47, 46])
    dl = true_dl(femto, truth, part)
    alone = ingest(part, femto)
    assert alone.sweeps.signed.tolist() == [False, False, True]
    np.testing.assert_allclose(alone.sweeps.dl, [abs(dl[0]), abs(dl[1]), dl[2]], atol=5e-3)
    random = np.random.default_rng(1)
    scanned = replace(part, scans_before=[scan(random, 900.0), None, None])
    scanned = replace(scanned, scans_after=[scan(random, 900.0 + dl[0]), None, None])
    found = ingest(scanned, femto)
    assert found.sweeps.signed.tolist() == [True, False, True]
    assert found.readings[0] is not None
    assert found.readings[0].sign_source == "scans"
    assert ingest(part, femto, estimate=near).sweeps.signed.all()


def test_points_make_groups_that_a_campaign_accepts(
    femto: Cell, truth: Truth, campaign: TraceIndex, near: Estimate
) -> None:
    part = picked(campaign, [0, 3, 46])
    for points in (1, 4):
        found = ingest(part, femto, estimate=near, settings=IngestSettings(points=points))
        check_sweeps(found.sweeps, femto)
        assert len(found.sweeps) == 3 * (points + 1)
        assert len(set(found.sweeps.group.tolist())) == 3
        model = CavityModel.of(femto, truth.parameters)
        dl = model.predict(truth.at(0.0), model.rows(found.sweeps.q_start, found.sweeps.q_end))
        assert (np.abs(found.sweeps.dl - dl) < 4.0 * found.sweeps.sigma).all()


def test_absolute_lengths_become_rows(femto: Cell, campaign: TraceIndex) -> None:
    part = picked(campaign, [0, 46])
    random = np.random.default_rng(4)
    empty = Trace(np.zeros(0), np.zeros(0), np.zeros(0))
    part = replace(
        part,
        sweeps=replace(part.sweeps, kind=np.array(["absolute", "sweep"])),
        traces=[empty, part.traces[1]],
        scans_before=[None, scan(random, 915.0)],
        scans_after=[scan(random, 925.0), scan(random, 955.0)],
    )
    found = ingest(part, femto)
    assert found.sweeps.kind.tolist() == ["absolute", "sweep"]
    assert found.sweeps.dl[0] == pytest.approx(925.0, abs=5 * found.sweeps.sigma[0])
    more = ingest(part, femto, settings=IngestSettings(absolute=True)).sweeps
    assert more.kind.tolist() == ["absolute", "sweep", "absolute", "absolute"]
    np.testing.assert_allclose(more.dl[2:], [915.0, 955.0], atol=0.05)
    np.testing.assert_array_equal(more.q_end[2], part.sweeps.q_start[1])


def test_wavelength_and_air_scale_the_change(femto: Cell, campaign: TraceIndex) -> None:
    part = picked(campaign, [46])
    plain = ingest(part, femto).sweeps
    longer = ingest(replace(part, wavelength=np.array([1.5615])), femto).sweeps
    assert longer.dl[0] / plain.dl[0] == pytest.approx(1.5615 / 1.56, rel=1e-6)
    air = {"temperature_c": np.array([20.0]), "pressure_hpa": np.array([1013.25]), "humidity_pct": np.array([50.0])}
    assert ingest(replace(part, **air), femto).sweeps.dl[0] / plain.dl[0] == pytest.approx(1 / 1.000268, rel=2e-6)
    vague = ingest(part, femto, settings=IngestSettings(wavelength_sd=1.56e-3, index_sd=1e-3)).sweeps
    assert vague.sigma[0] == plain.sigma[0]
    assert vague.scale_ppm[0] == pytest.approx(1000.0 * np.sqrt(2.0))
    cold = replace(part, **{**air, "temperature_c": np.array([-150.0])})
    with pytest.raises(InputError, match="air: "):
        ingest(cold, femto)


def test_doubtful_sweeps_are_listed_and_kept(femto: Cell, campaign: TraceIndex, tmp_path) -> None:  # type: ignore[no-untyped-def]
    part = picked(campaign, [0, 1, 46])
    flat = replace(part.traces[1], irradiance=np.ones(len(part.traces[1])))
    part = replace(part, traces=[part.traces[0], flat, part.traces[2]])
    found = ingest(part, femto)
    assert found.sweeps.label.tolist() == ["node0-rx", "orient0-0-0-ty"]
    assert found.doubtful.label.tolist() == ["node0-rz"]
    assert found.doubtful.recording.tolist() == [1]
    assert found.warnings == ("node0-rz: refused: the signal is constant",)
    kept = replace(Campaign.of(found.sweeps, femto), recordings=part, doubtful=found.doubtful)
    write_campaign(tmp_path / "c.h5", kept, femto)
    back = read_campaign(tmp_path / "c.h5", femto)
    assert back.doubtful is not None
    assert back.doubtful.reason.tolist() == ["refused: the signal is constant"]
    assert back.doubtful.alternatives == ((),)
    assert back.recordings is not None
    for one, other in zip(back.recordings.traces, part.traces, strict=True):
        np.testing.assert_array_equal(one.irradiance, other.irradiance)
    again = ingest(back.recordings, femto)
    np.testing.assert_allclose(again.sweeps.dl, found.sweeps.dl, rtol=1e-12)
    with pytest.raises(InputError, match="no sweep can be used; node0-rz: refused: the signal is constant"):
        ingest(picked(part, [1]), femto)


def test_a_mirror_image_far_beyond_its_sweep_is_none(femto: Cell) -> None:
    """The image of a late start of `node1-ry` lies a thousand sweeps away, since the mirror turns where it sets out."""
    paper, plan = paper_truth(femto), paper_protocol(femto)
    sds = np.array([p.prior_sd for p in paper.parameters])
    drawn = femto.free.nominal + sds * np.random.default_rng(199).standard_normal(21)
    truth = replace(paper, times_h=np.zeros(1), values=drawn[None])
    row = int(np.flatnonzero(plan.label == "node1-ry")[0])
    rows = np.array([row, *range(40, 50)])
    found = ingest(record_sweeps(femto, truth, plan, seed=199, scans=False).take(rows), femto).readings[0]
    assert found is not None
    assert found.good
    assert abs(found.dl - abs(noise_free(femto, truth, plan)[row])) < 4.0 * found.sigma


def test_a_path_is_no_sweep(femto: Cell, campaign: TraceIndex) -> None:
    part = picked(campaign, [0])
    with pytest.raises(InputError, match="row 2, column kind: expected sweep or absolute"):
        ingest(replace(part, sweeps=replace(part.sweeps, kind=np.array(["path"]))), femto)


def test_groups_are_dropped_and_said_so(femto: Cell, campaign: TraceIndex) -> None:
    part = picked(campaign, [46])
    found = ingest(replace(part, sweeps=replace(part.sweeps, group=np.array(["pair"]))), femto)
    assert found.sweeps.group.tolist() == [""]
    assert "groups of the index are dropped" in found.warnings[-1]
