"""Mistakes that a whole file may hold: named on a poor fit, and where a good fit hides one, with a sweep that tells."""

import re
from dataclasses import replace

import numpy as np
import pytest
from track_fixtures import DRIFT, PROTOCOL, plan

from fpcal_bayes.analysis.doctor import doctor
from fpcal_bayes.cli.main import main
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.mistakes import axis_sets, mend, mirror_sets
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.tracker import track

CELL = load_cell(mechanics="none")
TRUTH = paper_truth(CELL)


@pytest.fixture(scope="module")
def ends() -> Sweeps:
    return simulate_um(CELL, TRUTH, paper_protocol(CELL), sigma=0.005, seed=4)


@pytest.fixture(scope="module")
def middles() -> Sweeps:
    return simulate_um(CELL, TRUTH, paper_protocol(CELL, midpoints=True), sigma=0.005, seed=4)


def posed(sweeps: Sweeps, change) -> Sweeps:
    return replace(sweeps, q_start=change(sweeps.q_start), q_end=change(sweeps.q_end))


def other_way(sweeps: Sweeps, *joints: int) -> Sweeps:
    way = np.array([-1.0 if j + 1 in joints else 1.0 for j in range(6)])
    return posed(sweeps, lambda q: q * way)


def swapped(sweeps: Sweeps, i: int, j: int) -> Sweeps:
    order = list(range(6))
    order[i - 1], order[j - 1] = j - 1, i - 1
    return posed(sweeps, lambda q: q[:, order])


FAULTS = [
    ("q2 counts the other way", False, lambda s: other_way(s, 2)),
    ("q1 and q5 count the other way", False, lambda s: other_way(s, 1, 5)),
    ("the columns of q1 and q3 are swapped", True, lambda s: swapped(s, 1, 3)),
    ("dl_um has the other sign", True, lambda s: replace(s, dl=-s.dl)),
    ("dl_um stands in nm", True, lambda s: replace(s, dl=1e3 * s.dl)),
    ("dl_um and sigma_um stand in mm", False, lambda s: replace(s, dl=1e-3 * s.dl, sigma=1e-3 * s.sigma)),
    ("each dl_um stands in the row after its own", False, lambda s: replace(s, dl=np.roll(s.dl, 1))),
]


@pytest.mark.parametrize(("named", "mid", "fault"), FAULTS, ids=lambda value: value if isinstance(value, str) else "")
def test_a_mistake_is_named(named, mid, fault, ends, middles):
    wrong = fault(middles if mid else ends)
    found = identify(CELL, wrong, max_starts=2)
    assert not found.estimate.trust.usable
    first = mend(found.problem, found.solution, found.fit.standardised)[0]
    assert first.name.startswith(named)
    assert first.p_value > 1e-3


def test_the_doctor_says_so(ends):
    found = [finding for finding in doctor(other_way(ends, 2), CELL) if finding.severity == "problem"]
    assert [finding.kind for finding in found] == ["mistake"]
    assert "rows fit if q2 counts the other way" in found[0].what


def test_a_mistake_is_named_on_a_machine(ends):
    found = doctor(other_way(ends, 2), load_cell())
    assert any("fit if q2 counts the other way" in finding.what for finding in found)
    assert not identify(load_cell(), other_way(ends, 2)).estimate.trust.usable


def test_no_remedy_raises_sigma_alone(ends):
    noisy = replace(ends, dl=ends.dl + 0.02 * np.random.default_rng(1).standard_normal(len(ends)))
    for cell in (CELL, load_cell()):
        for finding in doctor(noisy, cell):
            assert "raise sigma_um" not in finding.remedy or "only if readings" in finding.remedy
            assert "lower sigma_um" not in finding.remedy


def test_an_axis_that_ends_alone_do_not_tell(ends, middles):
    wrong = other_way(ends, 6)
    (reason,) = identify(CELL, wrong).estimate.trust.reasons
    assert reason.kind == "second-solution"
    found = re.search(r"q6 from (\S+) to (\S+) deg, where dL is (\S+) um, or (\S+) um the other way", reason.text)
    assert found is not None, reason.text
    # What the machine does when it is sent there, its own q6 being that of the file the other way round.
    start, end = np.zeros((1, 6)), np.zeros((1, 6))
    start[0, 5], end[0, 5] = -float(found[1]), -float(found[2])
    driven = simulate_um(CELL, TRUTH, Sweeps.of_um_deg(CELL, start, end), sigma=1e-6, seed=0)
    assert driven.dl[0] == pytest.approx(float(found[4]), abs=0.2)
    assert abs(driven.dl[0] - float(found[3])) > 1.0
    assert not identify(CELL, middles).estimate.trust.reasons


def test_mirrors_of_the_world_are_no_warning(middles):
    assert [[j + 1 for j in axes] for axes in mirror_sets(CELL)] == [[1, 3, 4, 5], [1, 4, 6], [3, 5, 6]]
    assert len(axis_sets(CELL, np.ones(6, dtype=bool))) == 15
    own = identify(CELL, middles)
    for axes in mirror_sets(CELL):
        seen = identify(CELL, other_way(middles, *(j + 1 for j in axes)))
        assert seen.estimate.trust.verdict == "usable"
        # Another world exactly; the priors are not quite those of its mirror.
        assert seen.fit.chi2_data == pytest.approx(own.fit.chi2_data, abs=3.0)


def test_sigma_too_large_is_said_on_any_machine(ends):
    for cell in (CELL, load_cell()):
        found = identify(cell, replace(ends, sigma=1e3 * ends.sigma))
        assert found.estimate.trust.reasons[0].kind == "too-good-fit"


def test_a_fit_without_end_names_its_rows(ends):
    wrong = replace(ends, dl=ends.dl * 1e5)
    found = identify(CELL, wrong)
    text = " ".join(found.warnings)
    assert not found.estimate.trust.usable
    assert max(map(len, re.findall(r"\d+", text))) < 25


def test_rows_that_stand_twice_are_said(ends):
    found = identify(CELL, join([ends, ends.take(np.arange(5))]))
    assert "5 rows stand twice" in " ".join(found.warnings)


def week(seed: int) -> Sweeps:
    """A calibration and 15 sessions of 2 to 10 random sweeps at random times, while the cell drifts."""
    random = np.random.default_rng(seed)

    times = np.concatenate([[0.0], np.sort(random.uniform(2, 168, 15))])
    steps = random.standard_normal((16, 21)) * DRIFT.walk * DRIFT.scale
    steps *= np.sqrt(np.diff(times, prepend=0.0) / 24.0)[:, None]
    first = CELL.free.nominal + random.standard_normal(21) * CELL.free.prior_sd
    parts = [replace(PROTOCOL, session=np.full(69, "full"))]
    for i, time in enumerate(times[1:], 1):
        n = int(random.integers(2, 11))
        parts.append(replace(plan(n, random), session=np.full(n, f"s{i}"), time_h=np.full(n, time)))
    truth = Truth(CELL.free, times, first + np.cumsum(steps, axis=0))
    return simulate_um(CELL, truth, join(parts, file="week"), sigma=0.005, seed=seed)


@pytest.mark.parametrize("seed", [9, 28])
def test_updates_come_to_rest(seed):
    assert track(CELL, week(seed)).converged


def test_a_session_whose_sigma_is_too_large_is_said():
    sweeps = week(1)
    wide = replace(sweeps, sigma=np.where(sweeps.session == "s4", 1e6, 1.0) * sweeps.sigma)
    said = {outcome.session: outcome.warnings for outcome in track(CELL, wide).outcomes}
    assert "sigma_um is too large" in said["s4"][0]
    assert not any(texts for session, texts in said.items() if session not in ("s4", "full"))


@pytest.mark.parametrize(
    ("column", "factor", "expected"),
    [("sigma_um", 1e-6, "sigma_um: expected a standard deviation"), ("dl_um", 1e9, "dl_um: expected -1e+07 to 1e+07"),
     ("q6_end_deg", 1e3, "q6_end_deg: "), ("time_h", 1e9, "time_h: expected -1e+06 to 1e+06")],
)  # fmt: skip
def test_numbers_that_no_machine_has(column, factor, expected, tmp_path, capsys, ends):
    path = tmp_path / "a.csv"
    write_csv(path, replace(ends, time_h=np.full(69, 5.0)), CELL)
    header, *rows = path.read_text().splitlines()
    at = header.split(",").index(column)
    fields = rows[2].split(",")
    fields[at] = f"{float(fields[at]) * factor:.6g}"
    rows[2] = ",".join(fields)
    path.write_text("\n".join([header, *rows]) + "\n")
    for command in ("identify", "track", "doctor"):
        assert main([command, str(path)]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert f"row 4, column {expected}" in error
