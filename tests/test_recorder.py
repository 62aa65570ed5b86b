"""The simulated rig's recordings, read back by their own model."""

from dataclasses import replace

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol, single_sweep
from fpcal_bayes.measure.recordings import check_index
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.traces import Trace
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.interferometer import fringe, mirror_views
from fpcal_bayes.simulator.optics import Chances, RecorderSettings, SimulatedOptics
from fpcal_bayes.simulator.recorder import record_path, record_sweeps, reference_joint
from fpcal_bayes.simulator.sweeps import machine_of, noise_free, simulate

#: A poor day: gain, offset, second harmonic and noise relative to the fringes.
HARD = RecorderSettings(envelope_change=0.2, offset_drift=0.1, cyclic_error=0.01, noise=0.01)

CLEAN = RecorderSettings(envelope_change=0.0, offset_drift=0.0, noise=0.0)


@pytest.fixture(scope="module")
def truth(femto: Cell) -> Truth:
    return paper_truth(femto)


def counted(trace: Trace) -> float:
    """Fringes in a clean trace that never turns: half the crossings of its middle."""
    middle = (trace.irradiance.max() + trace.irradiance.min()) / 2
    return float((np.diff(np.sign(trace.irradiance - middle)) != 0).sum()) / 2


def test_fringes_are_those_of_the_change_of_length(femto: Cell, truth: Truth) -> None:
    plan = paper_protocol(femto)
    wanted = np.array([label in ("orient0-0-0-ty", "orient3-3-90-tz", "orient0-3-0-tx") for label in plan.label])
    plan = plan.take(wanted)
    index = record_sweeps(femto, truth, plan, CLEAN)
    check_index(index, femto)
    for trace, change in zip(index.traces, noise_free(femto, truth, plan), strict=True):
        assert counted(trace) == pytest.approx(abs(change) / (femto.wavelength / 2), abs=0.5)
    assert not index.sweeps.measured


def test_default_recordings_are_good_data(femto: Cell, truth: Truth) -> None:
    """At least 35 samples a fringe, no clipping, and the ends of the joint where the plan has them."""
    plan = paper_protocol(femto)
    settings = replace(HARD, noise=None)
    index = record_sweeps(femto, truth, plan, settings, scans=False)
    scale = femto.interferometer.full_scale
    assert all(0.02 * scale < t.irradiance.min() and t.irradiance.max() < 0.95 * scale for t in index.traces)
    samples = [len(t) for t in index.traces]
    needed = SimulatedOptics(femto, truth, RecorderSettings(samples_per_fringe=35.0)).counts(
        plan.q_start, plan.q_end, plan.time_h
    )
    assert (samples >= needed).all()
    moved = np.argmax(plan.q_start != plan.q_end, axis=1)
    rows = np.arange(len(plan))
    np.testing.assert_array_equal([t.joint[0] for t in index.traces], plan.q_start[rows, moved])
    np.testing.assert_array_equal([t.joint[-1] for t in index.traces], plan.q_end[rows, moved])


def test_velocity_ripple_is_as_stated(femto: Cell, truth: Truth) -> None:
    trace = record_sweeps(femto, truth, single_sweep(femto, 3, -150.0, 150.0), CLEAN, scans=False).traces[0]
    speed = np.diff(trace.joint) / np.diff(trace.time_s)
    assert speed.min() == pytest.approx(27.0, rel=1e-3)
    assert speed.max() == pytest.approx(33.0, rel=1e-3)


def test_rest_before_and_after_the_motion(femto: Cell, truth: Truth) -> None:
    trace = record_sweeps(femto, truth, single_sweep(femto, 3, -150.0, 150.0), replace(CLEAN, rest_s=1.0)).traces[0]
    assert len(trace) == 2401
    assert (trace.joint[:201] == -150.0).all()
    assert (trace.joint[-201:] == 150.0).all()
    assert (np.diff(trace.joint[200:-200]) > 0).all()
    assert trace.time_s[-1] == pytest.approx(12.0)


def test_equal_seeds_give_equal_recordings_row_by_row(femto: Cell, truth: Truth) -> None:
    plan = paper_protocol(femto).take(np.arange(4))
    one, other = (record_sweeps(femto, truth, plan, HARD, seed=5) for _ in range(2))
    alone = record_sweeps(femto, truth, plan.take(np.arange(2)), HARD, seed=5)
    changed = record_sweeps(femto, truth, plan, HARD, seed=6)
    for i in range(4):
        np.testing.assert_array_equal(one.traces[i].irradiance, other.traces[i].irradiance)
        assert (one.traces[i].irradiance != changed.traces[i].irradiance).any()
    np.testing.assert_array_equal(one.traces[1].irradiance, alone.traces[1].irradiance)


@pytest.mark.parametrize("wanted", [4.0, 400.0])
def test_samples_per_fringe_are_kept_at_the_fastest_place(femto: Cell, truth: Truth, wanted: float) -> None:
    plan = paper_protocol(femto).take(np.array([3, 46, 47]))
    index = record_sweeps(femto, truth, plan, RecorderSettings(samples_per_fringe=wanted), scans=False)
    rig, model = SimulatedOptics(femto, truth, CLEAN), CavityModel.of(femto)
    for i, trace in enumerate(index.traces):
        q = np.repeat(plan.q_start[i : i + 1], len(trace), axis=0)
        joint = int(np.argmax(plan.q_start[i] != plan.q_end[i]))
        q[:, joint] = trace.joint
        fastest = np.abs(np.diff(mirror_views(model, truth.values[0], q)[0])).max()
        fewest = rig.settings.fewest_samples
        if len(trace) > fewest:
            assert wanted <= femto.wavelength / 2 / fastest < 1.25 * wanted


def test_noise_is_relative_to_the_fringe_or_the_cells_own(femto: Cell, truth: Truth) -> None:
    plan, none = single_sweep(femto, 2, -20.0, 20.0), {"envelope_change": 0.0, "offset_drift": 0.0}
    clean = record_sweeps(femto, truth, plan, CLEAN, scans=False).traces[0].irradiance
    relative = record_sweeps(femto, truth, plan, RecorderSettings(noise=0.03, **none), scans=False).traces[0].irradiance
    volts = record_sweeps(femto, truth, plan, RecorderSettings(**none), scans=False).traces[0].irradiance
    height = np.ptp(clean) / 2
    assert (relative - clean).std() == pytest.approx(0.03 * height, rel=0.06)
    assert (volts - clean).std() == pytest.approx(femto.interferometer.noise, rel=0.06)


def test_cyclic_error_is_a_second_harmonic(femto: Cell, truth: Truth) -> None:
    plan = single_sweep(femto, 2, -15.6, 15.6)
    clean, bent = (
        record_sweeps(
            femto, truth, plan, replace(CLEAN, cyclic_error=share, velocity_ripple=0.0, fading=False), scans=False
        )
        .traces[0]
        .irradiance
        for share in (0.0, 0.05)
    )
    spectrum = np.abs(np.fft.rfft((bent - clean)[:-1]))
    height = np.abs(np.fft.rfft(clean[:-1]))[40]
    assert int(np.argmax(spectrum)) == 80
    assert spectrum[80] == pytest.approx(0.05 * height, rel=0.05)


def test_wavelength_drift_looks_like_a_change_of_length(femto: Cell, truth: Truth) -> None:
    """0.6 nm a pm: 100 pm during a sweep of 40 um add 59 nm to it."""
    plan = single_sweep(femto, 2, -20.0, 20.0)
    settings = replace(CLEAN, velocity_ripple=0.0, wavelength_drift=100e-6)
    still, drifting = (
        record_sweeps(femto, truth, plan, s, scans=False).traces[0]
        for s in (replace(settings, wavelength_drift=0.0), settings)
    )
    # The phase at the end: that of a cavity shorter by L x 100 pm / lambda.
    rig = SimulatedOptics(femto, truth, CLEAN)
    length, distance, tilt = rig.views(plan.q_end, plan.time_h, np.zeros(1, dtype=np.int64))
    mean, height = fringe(femto.interferometer, distance, tilt)
    shorter = length / (1.0 + 100e-6 / 1.56)
    expected = femto.interferometer.gain * (mean + height * np.cos(4 * np.pi * shorter / 1.56)) + 0.05
    assert drifting.irradiance[-1] == pytest.approx(float(expected[0]), abs=1e-4)
    assert still.irradiance[0] == drifting.irradiance[0]
    assert float((length - shorter)[0]) == pytest.approx(0.0594, rel=0.03)


def test_scans_show_the_length(femto: Cell, truth: Truth) -> None:
    """Fringes of a scan from 1,520 to 1,600 nm: 2 L (1 / 1.52 - 1 / 1.6)."""
    plan = join([single_sweep(femto, 3, -150.0, 150.0), single_sweep(femto, 2, -20.0, 20.0)])
    index = record_sweeps(femto, truth, plan, CLEAN, scans=np.array([True, False]))
    assert index.scans_before[1] is None is index.scans_after[1]
    scan = index.scans_before[0]
    assert scan is not None
    rig = SimulatedOptics(femto, truth, CLEAN)
    length = rig.views(plan.q_start[:1], plan.time_h[:1], np.zeros(1, dtype=np.int64))[0][0]
    trace = Trace(scan.wavelength, scan.wavelength, scan.irradiance)
    assert counted(trace) == pytest.approx(2 * length * (1 / 1.52 - 1 / 1.6), abs=0.5)


def test_absolute_lengths_have_a_scan_and_no_trace(femto: Cell, truth: Truth) -> None:
    plan = replace(single_sweep(femto, 2, 0.0, 10.0), kind=np.array(["absolute"]))
    index = record_sweeps(femto, truth, plan, scans=False)
    assert len(index.traces[0]) == 0
    assert index.scans_after[0] is not None
    check_index(index, femto)


def test_a_path_starts_at_half_height_and_returns(femto: Cell, truth: Truth) -> None:
    path = np.zeros((31, 6))
    turn = np.linspace(0.0, 2 * np.pi, 31)
    path[:, 0], path[:, 2] = 50 * np.cos(turn), 50 * np.sin(turn)
    trace = record_path(femto, truth, path, 0.0, CLEAN, seed=1)
    read = trace.irradiance[trace.before]
    middle, height = (read.max() + read.min()) / 2, np.ptp(read) / 2
    assert trace.irradiance[trace.path][0] == pytest.approx(middle, abs=0.02 * height)
    assert trace.irradiance[trace.path][-1] == pytest.approx(trace.irradiance[trace.path][0], abs=2e-3)
    lengths = mirror_views(CavityModel.of(femto), truth.values[0], trace.q)[0]
    assert trace.length is not None
    np.testing.assert_allclose(trace.length, lengths)
    # Moved along the optical axis only, by an eighth of a wavelength at most.
    moved = trace.q[trace.path][0] - path[0]
    joint, slope = reference_joint(femto, path[0])
    assert (joint, slope) == (1, pytest.approx(-1.0))
    assert np.flatnonzero(moved).tolist() == [1]
    assert abs(moved[1]) <= femto.wavelength / 8 + 1e-9


def test_a_path_at_the_end_of_its_range_is_scanned_inwards(femto: Cell, truth: Truth) -> None:
    path = np.zeros((5, 6))
    path[:, 1] = 149.9
    path[:, 0] = np.linspace(-10, 10, 5)
    trace = record_path(femto, truth, path)
    assert trace.q[:, 1].max() <= 150.0


def test_bad_input_is_refused(femto: Cell, truth: Truth) -> None:
    plan = paper_protocol(femto, midpoints=True)
    with pytest.raises(InputError, match="row 2, column group: expected no group"):
        record_sweeps(femto, truth, plan)
    with pytest.raises(InputError, match="expected a sweep of one joint"):
        record_sweeps(femto, truth, replace(single_sweep(femto, 1, 0.0, 1.0), q_end=np.ones((1, 6)) * 0.01))
    with pytest.raises(InputError, match="seed -1"):
        record_sweeps(femto, truth, single_sweep(femto, 1, 0.0, 1.0), seed=-1)
    with pytest.raises(InputError, match="expected two or more vectors"):
        record_path(femto, truth, np.zeros((1, 6)))
    with pytest.raises(InputError, match="more than two turns"):
        record_path(femto, truth, np.full((2, 6), 1000.0))
    with pytest.raises(InputError, match="velocity_ripple = 1"):
        RecorderSettings(velocity_ripple=1.0)
    with pytest.raises(InputError, match="noise = -1"):
        RecorderSettings(noise=-1.0)


def test_a_machine_records_the_lengths_that_it_measures(truth: Truth) -> None:
    cell = load_cell()
    plan = paper_protocol(cell).take(np.arange(6))
    index = record_sweeps(cell, truth, plan, CLEAN, seed=4, scans=False)
    measured = simulate(cell, truth, plan, sigma_nm=1e-3, seed=4)
    perfect = noise_free(cell, truth, plan)
    assert np.abs(measured.dl - perfect).max() > 0.05
    # The machine of the same seed, from the same sides, with the same return errors.
    machine = replace(machine_of(cell, truth, 4), rng=np.random.default_rng([4, 6]))
    drive = drive_of_sweeps(plan, cell.mechanics.minutes_per_sweep)
    reached = machine.reached(drive)
    ends = [(plan.q_start, reached[0], drive.start_min, 0), (plan.q_end, reached[1], drive.end_min, -1)]
    rig, lengths = SimulatedOptics(cell, truth, CLEAN), []
    for q, errors, minutes, place in ends:
        lengths.append(machine.lengths(q, errors + machine.periodic(q), minutes))
        _, distance, tilt = mirror_views(CavityModel.of(cell), machine.vector[cell.free.slots], q)
        seen = [
            rig.voltages((np.array([length]), np.array([far]), np.array([turned])), Chances.several(0, 1, 6)[0])[0]
            for length, far, turned in zip(lengths[-1], distance, tilt, strict=True)
        ]
        np.testing.assert_allclose([trace.irradiance[place] for trace in index.traces], seen, atol=2e-3)
    np.testing.assert_allclose(measured.dl, lengths[1] - lengths[0], atol=1e-5)


def test_a_machine_keeps_its_errors_along_a_path(truth: Truth) -> None:
    cell, path = load_cell(), np.zeros((6, 6))
    path[:, 0], path[:, 5] = [0, 40, 80, 60, 60, 0], [0.0, 0.1, 0.2, 0.3, 0.1, 0.0]
    trace = record_path(cell, truth, path, settings=replace(CLEAN, quadrature=False), seed=2)
    machine = replace(machine_of(cell, truth, 2), rng=np.random.default_rng([2, 6]))
    expected = machine.lengths(path, machine.reach(path, machine.side), np.zeros(6))
    np.testing.assert_allclose(trace.length[~trace.reference][::400], expected, atol=1e-9)
    other = record_path(cell.ideal, truth, path, settings=replace(CLEAN, quadrature=False), seed=2)
    assert np.ptp((trace.length - other.length)[~trace.reference]) > 0.01
