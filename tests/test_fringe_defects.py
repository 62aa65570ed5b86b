"""Light as it is: stages that do not follow their joint, coarse converters, other units, lasers that hop."""

from dataclasses import replace

import numpy as np
import pytest
from trace_fixtures import irradiance

from fpcal_bayes.cli.main import main
from fpcal_bayes.fringes.count import ALONE, Reading, shared_odds
from fpcal_bayes.fringes.ingest import read_index
from fpcal_bayes.fringes.profile import DisplacementProfile
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.fringes.search import find_profiles
from fpcal_bayes.fringes.wavelength_scan import read_wavelength_scan
from fpcal_bayes.io.recordings import write_recordings
from fpcal_bayes.measure.protocol import single_sweep
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.traces import Trace, WavelengthScan
from fpcal_bayes.model.cell.cell import Cell

LIGHT = 1.56


def recorded(
    travel: float,
    mirror: np.ndarray,
    joint: np.ndarray,
    seed: int,
    *,
    volts: float = 1.0,
    step: float = 0.0,
    begin: float | None = None,
) -> tuple[Trace, float]:
    """A trace of q2, which moves the mirror along the beam, with the change of L; both courses as shares of the travel.

    The nominal cell's L falls as q2 rises. begin: phase in rad where the joint starts.
    """
    random, time = np.random.default_rng(seed), np.linspace(0.0, 1.0, len(joint))
    phase = -4.0 * np.pi / LIGHT * travel * mirror + random.uniform(0.0, 2.0 * np.pi)
    phase += 0.0 if begin is None else begin - phase[0] - 4.0 * np.pi / LIGHT * travel * mirror[0]
    signal = volts * (0.5 + irradiance(random, phase, time))
    signal = np.rint(signal / step) * step if step else signal
    return Trace(10.0 * time, travel * (joint - 0.5), signal), -travel * float(mirror[-1] - mirror[0])


def read(cell: Cell, travel: float, traces: list[Trace]) -> list[Reading]:
    sweeps = join([single_sweep(cell, 2, -travel / 2, travel / 2)] * len(traces), "sweeps")
    sweeps = replace(sweeps, label=np.array([f"s{i}" for i in range(len(traces))]))
    readings = read_index(TraceIndex.of(sweeps, traces), cell).readings
    return [reading for reading in readings if reading is not None]


def late(n: int, place: float) -> np.ndarray:
    return np.maximum(np.linspace(0.0, 1.0, n), place)


def assert_right(reading: Reading, true: float, *, most_nm: float = 30.0) -> None:
    assert reading.good, reading.refused or reading.doubt
    assert abs(reading.dl - true) < 4.5 * reading.sigma
    assert 1e3 * reading.sigma < most_nm
    assert -1.0 <= reading.set_out < reading.stop <= 1.0
    assert reading.late >= 0.0


@pytest.mark.parametrize("travel", [4.0, 6.0, 18.0])
def test_short_sweeps_of_a_well_known_cell_are_read(femto: Cell, travel: float) -> None:
    """Their slope is known better than one step of the search."""
    course = np.linspace(0.0, 1.0, 300)
    trace, true = recorded(travel, course, course, 1)
    assert_right(read(femto, travel, [trace])[0], true, most_nm=5.0)


@pytest.mark.parametrize("sd", [1e-1, 1e-3, 1e-6])
def test_a_narrow_prior_finds_its_profile(sd: float) -> None:
    profile = DisplacementProfile(np.array([9.0, 0, 0, 0, 0, 0]), np.diag([sd**2, 1e-12, 0, 0, 0, 0]))
    s = np.linspace(-1.0, 1.0, 600)
    phase = 4.0 * np.pi / LIGHT * (9.0 + 0.5 * sd) * s
    samples = Samples(s, s, irradiance(np.random.default_rng(0), phase, (s + 1) / 2), np.ones(600))
    found = find_profiles(samples, profile, 4.0 * np.pi / LIGHT)
    assert len(found) > 0
    assert abs(abs(found[0, 0]) - 9.0) < 0.2


def test_another_scale_of_the_joint_is_told_by_the_fringes(femto: Cell) -> None:
    course = np.linspace(0.0, 1.0, 1000)
    trace, _ = recorded(40.0, 1.15 * course, course, 2)
    assert read(femto, 40.0, [trace])[0].refused == "51 fringes expected, 59 seen: check the joint's unit and scale"


def test_a_coarse_converter_is_read_and_a_clipped_signal_is_not(femto: Cell) -> None:
    course = np.linspace(0.0, 1.0, 2000)
    trace, true = recorded(15.0, course, course, 3, step=5.0 / 255.0)
    assert_right(read(femto, 15.0, [trace])[0], true, most_nm=2.0)
    clipped = replace(trace, irradiance=np.minimum(trace.irradiance, 115 * (5.0 / 255.0)))
    assert "lower the gain to 0." in read(femto, 15.0, [clipped])[0].refused


@pytest.mark.parametrize(("volts", "unit"), [(1000.0, "perhaps millivolts"), (13107.0, "perhaps counts")])
def test_other_units_are_named_with_what_was_found(femto: Cell, volts: float, unit: str) -> None:
    course = np.linspace(0.0, 1.0, 500)
    trace, _ = recorded(20.0, course, course, 4, volts=volts, step=1.0 if volts > 2000 else 0.01)
    refused = read(femto, 20.0, [trace])[0].refused
    assert "expected volts up to the full scale of 5 V, found" in refused
    assert unit in refused


def test_lost_motion_that_all_traces_share_is_no_noise(femto: Cell) -> None:
    made = [recorded(30.0, late(700, 1.0 / 30.0), np.linspace(0.0, 1.0, 700), seed) for seed in range(5)]
    for reading, (_, true) in zip(read(femto, 30.0, [trace for trace, _ in made]), made, strict=True):
        assert_right(reading, true)
        assert reading.late == pytest.approx(1.0, abs=0.06)


def test_a_late_start_that_two_samples_show_is_seen(femto: Cell) -> None:
    """Where the fringe is at an extreme, and a block of samples tells no phase."""
    course = np.linspace(0.0, 1.0, 3000)
    for begin in (0.02, 0.05, 0.1, np.pi + 0.05):
        trace, true = recorded(150.0, np.maximum(course, 0.0636 / 150.0), course, 1, begin=begin)
        reading = read(femto, 150.0, [trace])[0]
        assert abs(reading.dl - true) < 4.0 * reading.sigma


def test_odds_of_a_defect_are_learnt_from_the_other_traces() -> None:
    """A stage has it never or in a share of its traces; what tells nothing changes nothing."""
    assert shared_odds(np.zeros((0, 2)), np.zeros(0)).shape == (0, 2)
    assert shared_odds(np.array([[1e9], [np.nan], [np.nan]]), np.zeros(3)) == pytest.approx(
        np.array([[ALONE], [2.0], [2.0]]), rel=0.02
    )
    clean = shared_odds(np.full((20, 1), 1e-3), np.zeros(20))
    assert (clean < 0.01 * ALONE).all()
    late = shared_odds(np.array([[0.02], *[[1e12]] * 19]), np.zeros(20))
    assert late[0, 0] == pytest.approx(20.0, rel=0.1)
    # One of twenty: by Laplace's rule of succession.
    one = shared_odds(np.array([[0.02], [1e12], *[[0.0]] * 18]), np.zeros(20))
    assert one[0, 0] == pytest.approx(2.0 / 19.0, rel=0.1)
    # What one joint has, says nothing of another.
    apart = shared_odds(np.array([[0.02], *[[1e12]] * 19, *[[1e-3]] * 20]), np.repeat([0, 1], 20))
    assert apart[0] == pytest.approx(late[0])
    assert apart[20] == pytest.approx(clean[0])


@pytest.mark.parametrize("end", ["start", "end"])
def test_what_an_extreme_hides_is_judged_by_the_other_traces(femto: Cell, end: str) -> None:
    """A delay from before an extreme of the fringe to behind it: two samples tell little, the other traces the rest."""
    course, travel, doubted = np.linspace(0.0, 1.0, 269), 11.0, 0

    def missing(missed: float, seed: int, begin: float | None) -> tuple[Trace, float]:
        mirror = np.maximum(course, missed / travel) if end == "start" else np.minimum(course, 1.0 - missed / travel)
        if begin is not None and end == "end":
            begin += 4.0 * np.pi / LIGHT * travel
        return recorded(travel, mirror, course, seed, begin=begin)

    clean = [missing(0.0, 100 + i, None)[0] for i in range(8)]
    late = [missing(0.7 + 0.05 * i, 200 + i, None)[0] for i in range(8)]
    begin, sigmas = 0.24 if end == "start" else -0.24, []
    for seed in range(2, 5):
        fine, true = missing(0.0, seed, begin)
        found = [read(femto, travel, [fine, *others])[0] for others in (clean, [], late)]
        assert_right(found[0], true, most_nm=1.0)
        sigmas.append([each.sigma for each in found])
        hidden, true = missing(0.062, seed, begin)
        reading = read(femto, travel, [hidden, *late])[0]
        assert not reading.good or abs(reading.dl - true) < 4.5 * reading.sigma
        doubted += "an extreme of the fringe hides it" in reading.doubt
    among_clean, alone, among_late = np.array(sigmas).T
    assert (among_clean < 1.05 * alone).all()
    assert (alone < 1.001 * among_late).all()
    assert among_late.max() > 5.0 * among_clean.max()
    assert doubted > 0


def test_a_trace_that_is_told_of_alone_is_read_among_the_others(femto: Cell) -> None:
    made = [recorded(30.0, late(700, 1.0 / 30.0), np.linspace(0.0, 1.0, 700), seed)[0] for seed in range(5)]
    index = TraceIndex.of(join([single_sweep(femto, 2, -15.0, 15.0)] * 5, "sweeps"), made)
    (one,), every = read_index(index, femto, told=np.array([3])).readings, read_index(index, femto).readings
    assert (one.dl, one.sigma, one.late) == (every[3].dl, every[3].sigma, every[3].late)


def test_a_mirror_that_stops_early_is_read_as_one_that_sets_out_late(femto: Cell) -> None:
    course = np.linspace(0.0, 1.0, 700)
    made = [recorded(30.0, np.minimum(course, 1.0 - 1.0 / 30.0), course, seed) for seed in range(3)]
    for reading, (_, true) in zip(read(femto, 30.0, [trace for trace, _ in made]), made, strict=True):
        assert_right(reading, true)
        assert reading.late == pytest.approx(1.0, abs=0.06)
        changes, _ = reading.changes(np.array([reading.stop, 1.0]))
        assert changes == pytest.approx([reading.dl, reading.dl])
    trace, _ = recorded(30.0, np.minimum(course, 1.0 - 2.4 / 30.0), course, 0)
    assert "stops" in read(femto, 30.0, [trace])[0].doubt


def test_a_mirror_that_misses_more_than_two_fringes_is_in_doubt(femto: Cell) -> None:
    for missed in (1.6, 2.0, 2.4, 4.0):
        trace, true = recorded(30.0, late(700, missed / 30.0), np.linspace(0.0, 1.0, 700), 0)
        reading = read(femto, 30.0, [trace])[0]
        if missed == 1.6:
            assert_right(reading, true)
        else:
            assert reading.refused or reading.doubt


def test_a_stage_that_runs_unevenly_is_read_by_its_fringes(femto: Cell) -> None:
    """A joint column of commanded values; two per mille of scale, shared by five traces, and a slow wave."""
    course = np.linspace(0.0, 1.0, 700)
    mirror = 1.002 * course + 0.004 * np.sin(2.0 * np.pi * course)
    made = [recorded(20.0, mirror, course, seed) for seed in range(5)]
    for reading, (_, true) in zip(read(femto, 20.0, [trace for trace, _ in made]), made, strict=True):
        assert_right(reading, true)
        assert reading.uneven


def test_a_lag_is_read_at_rest_and_in_doubt_without(femto: Cell) -> None:
    joint = np.concatenate([np.linspace(0.0, 1.0, 800), np.ones(400)])
    mirror, share = joint.copy(), np.exp(-1.0 / 20.0)
    for i in range(1, len(mirror)):
        mirror[i] = share * mirror[i - 1] + (1.0 - share) * joint[i]
    trace, true = recorded(20.0, mirror, joint, 6)
    assert_right(read(femto, 20.0, [trace])[0], true)
    cut = Trace(trace.time_s[:800], trace.joint[:800], trace.irradiance[:800])
    assert "before the mirror stands still" in read(femto, 20.0, [cut])[0].doubt


@pytest.mark.parametrize("hop_nm", [0.0, 0.002, 0.02, 0.1])
def test_a_laser_that_hops_widens_a_length(hop_nm: float) -> None:
    length, told = 920.0, np.linspace(1.52, 1.60, 1601)
    random = np.random.default_rng(7)
    hopped = told + 1e-3 * hop_nm * (np.arange(1601) > 900)
    phase = 4.0 * np.pi * length / hopped
    found = read_wavelength_scan(WavelengthScan(told, irradiance(random, phase, np.linspace(0, 1, 1601))), 925.0, 100.0)
    assert found.good
    assert abs(found.length - length) < 4.0 * found.sigma
    assert found.sigma < 0.005 + hop_nm


def test_a_scan_that_no_hop_explains_is_refused_or_covered() -> None:
    random, told = np.random.default_rng(8), np.linspace(1.52, 1.60, 801)
    wandering = told + 5e-6 * np.cumsum(random.normal(size=801))
    phase = 4.0 * np.pi * 920.0 / wandering
    found = read_wavelength_scan(WavelengthScan(told, irradiance(random, phase, np.linspace(0, 1, 801))), 920.0, 100.0)
    assert not found.good or abs(found.length - 920.0) < 4.0 * found.sigma


def test_the_command_shows_what_the_mirror_did(femto: Cell, tmp_path, capsys) -> None:  # type: ignore[no-untyped-def]
    trace, _ = recorded(20.0, late(600, 0.05), np.linspace(0.0, 1.0, 600), 9)
    sweep = replace(single_sweep(femto, 2, -10.0, 10.0), label=np.array(["late"]))
    write_recordings(tmp_path / "index.csv", TraceIndex.of(sweep, [trace]), femto)
    assert main(["trace", str(tmp_path / "index.csv"), "--figure", str(tmp_path / "late.svg")]) == 0
    told = capsys.readouterr()
    assert "lost motion" in told.out
    assert "the mirror does not follow its joint" in told.err
    assert "the mirror stands still" in (tmp_path / "late.svg").read_text(encoding="utf-8")
    assert main(["trace", str(tmp_path / "index.csv"), "--label", "other"]) == 2
