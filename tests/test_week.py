import io
import json
import xml.etree.ElementTree as ElementTree
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.traces import read_path_trace
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.study.paper_week import CHECK_HOURS, SESSIONS, identify_session, measure_week, week_truth
from fpcal_bayes.tracking.drift import DriftModel

pytestmark = pytest.mark.slow

CELL = load_cell(mechanics="none")
NAMES = [session.name for session in SESSIONS]


@pytest.fixture(scope="module")
def runs(shared_folder) -> tuple[list[Path], str, str]:
    """The week, run twice: silently into a new folder, then into one that holds a file; what the second run prints."""

    def make(root: Path) -> None:
        (root / "second").mkdir()
        (root / "second" / "mine.txt").write_text("kept")
        silent, _ = printed(["week", "-o", str(root / "first"), "--quiet", "--seed", "3"])
        out, err = printed(["week", "-o", str(root / "second"), "--seed", "3", "--no-page"])
        (root / "printed.json").write_text(json.dumps([silent, out, err]))

    root = shared_folder("week", make)
    silent, out, err = json.loads((root / "printed.json").read_text())
    assert silent == ""
    return [root / "first", root / "second"], out, err


def printed(arguments: list[str]) -> tuple[str, str]:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert main(arguments) == 0
    return out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def weeks(runs) -> list[Path]:
    return runs[0]


@pytest.fixture(scope="module")
def week(weeks) -> Path:
    return weeks[0]


@pytest.fixture(scope="module")
def estimates(week) -> dict[str, dict]:
    return {name: json.loads((week / f"{name}.json").read_text()) for name in NAMES}


def test_files(week):
    figures = {f"{name}.svg" for name in ("extrinsics", "circles", "courses")}
    data = {"report.html", "campaign.h5", "policy.h5", "posterior.nc", "report.txt", "estimate.json", "circles"}
    assert {path.name for path in week.iterdir()} == figures | data | {f"{name}.json" for name in NAMES}


def test_sessions_are_the_papers():
    assert [(s.name, s.day, s.free) for s in SESSIONS] == [
        ("full-T0", 0, "all"),
        ("full-day1", 1, "all"),
        ("full-day2", 2, "all"),
        ("extrinsic-day7", 7, "extrinsic"),
        ("full-day8", 8, "all"),
    ]


def test_estimates_can_be_read_and_are_near_the_truth(week, estimates):
    truth = paper_truth(CELL)
    for session in SESSIONS:
        estimate = read_estimate(week / f"{session.name}.json", CELL)
        assert estimate.time_h == 24.0 * session.day
        assert estimates[session.name]["data"] == {"file": "campaign.h5", "session": session.name}
        assert estimates[session.name]["fit"]["converged"] is True
        if session.free == "all":
            errors = (estimate.values - truth.at(estimate.time_h)) / estimate.sd
            assert np.abs(errors).max() < 5
            assert estimates[session.name]["fit"]["p_value"] > 1e-3


def test_stale_intrinsics_on_day_7(estimates):
    day2, day7 = estimates["full-day2"], estimates["extrinsic-day7"]
    fixed = {name for name, entry in day7["parameters"].items() if entry["status"] == "fixed"}
    assert fixed == set(CELL.select("intrinsic").names)
    for name in fixed:
        for key in ("value", "sd"):
            assert day7["parameters"][name][key] == pytest.approx(day2["parameters"][name][key], rel=1e-6)
    assert day7["fit"]["chi2_data"] > 1000
    assert any(w.startswith("poor fit") and "stale" in w for w in day7["warnings"])
    assert not any(w.startswith("poor fit") for w in day2["warnings"])


def test_warnings_name_their_session(runs):
    _, out, err = runs
    lines = [line for line in err.splitlines() if not line.startswith("fpcal: compiling")]
    assert all(line.startswith("fpcal: warning: ") for line in lines)
    assert any(line.startswith("fpcal: warning: extrinsic-day7: poor fit") for line in lines)
    assert "5 sessions, 345 sweeps in " in out
    assert "\x1b" not in out + err


def test_report(week):
    text, posterior = (week / "report.txt").read_text().split("Posterior of day 0")
    sampled = [line.split() for line in posterior.splitlines() if line.strip()]
    assert {row[0] for row in sampled if row[0] in CELL.free.names} == set(CELL.free.names)
    starts = [text.index(f"Day {session.day:g}: {session.tables} of the paper anew") for session in SESSIONS]
    assert starts == sorted(starts)
    for session, section in zip(SESSIONS, np.split(np.array(list(text)), starts)[1:], strict=True):
        lines = "".join(section).splitlines()
        rows = {line.split()[0]: line.split() for line in lines if line.split() and line.split()[0] in CELL.free.names}
        assert set(rows) == set(CELL.select(session.free).names)
        # Name, unit, truth, identified, sd, error / sd, status.
        assert all(len(row) == 7 for row in rows.values())
        for start in (
            "reflection point wPr",
            "reflection point tPr",
            "fit: converged",
            "rank: ",
            "largest residuals: ",
        ):
            assert any(line.startswith(start) for line in lines), (session.name, start)


def test_campaign_holds_everything(week):
    campaign = read_campaign(week / "campaign.h5", CELL)
    assert campaign.command == "fpcal week --sigma-nm 5 --seed 3 --between steady"
    assert campaign.seed == 3
    assert list(campaign.sweeps.sessions) == NAMES
    assert len(campaign.sweeps) == 5 * 69
    assert campaign.truth is not None
    assert campaign.truth.times_h.tolist() == [0.0, 24.0, 48.0, 192.0]


@pytest.mark.parametrize("name", ["full-T0", "full-day2", "full-day8"])
def test_identify_on_the_campaign_gives_the_same(week, estimates, tmp_path, name):
    out = tmp_path / "out.json"
    assert main(["identify", str(week / "campaign.h5"), "--session", name, "--json", str(out), "--quiet"]) == 0
    again = json.loads(out.read_text())
    assert again["fit"]["sum_of_squares"] == pytest.approx(estimates[name]["fit"]["sum_of_squares"], abs=1e-6)
    for parameter, entry in again["parameters"].items():
        expected = estimates[name]["parameters"][parameter]
        assert entry["value"] == pytest.approx(expected["value"], abs=1e-4 * expected["sd"])
        assert entry["sd"] == pytest.approx(expected["sd"], rel=1e-5)


def test_extrinsic_identification_on_the_campaign_gives_the_same(week, estimates, tmp_path):
    out = tmp_path / "out.json"
    arguments = ["--session", "extrinsic-day7", "--free", "extrinsic", "--start", str(week / "full-day2.json")]
    assert main(["identify", str(week / "campaign.h5"), *arguments, "--json", str(out), "--quiet"]) == 0
    again, expected = json.loads(out.read_text()), estimates["extrinsic-day7"]
    assert again["fit"]["sum_of_squares"] == pytest.approx(expected["fit"]["sum_of_squares"], rel=1e-6)
    for name in CELL.select("extrinsic").names:
        sd = expected["parameters"][name]["sd"]
        assert again["parameters"][name]["value"] == pytest.approx(expected["parameters"][name]["value"], abs=0.01 * sd)


def test_a_second_run_gives_the_same_bytes(weeks):
    for path in sorted(path for path in weeks[0].rglob("*") if path.is_file() and path.name != "report.html"):
        contents = [path.read_bytes(), (weeks[1] / path.relative_to(weeks[0])).read_bytes()]
        if path.name.removesuffix(".json") in NAMES:
            found = [json.loads(content) for content in contents]
            for content in found:
                assert content["fit"].pop("seconds") > 0
                # It covers the time.
                assert content.pop("content_sha256")
            contents = [json.dumps(content).encode() for content in found]
        assert contents[0] == contents[1], path.name


def test_another_seed_gives_other_data():
    (_, first), (_, second) = (measure_week(CELL, sigma=0.005, seed=seed) for seed in (1, 2))
    assert (first.dl != second.dl).all()
    np.testing.assert_allclose((first.dl - second.dl).std(), 0.005 * np.sqrt(2), rtol=0.2)


def test_figure(week):
    tree = ElementTree.parse(week / "extrinsics.svg")
    assert tree.getroot().tag.endswith("svg")
    text = (week / "extrinsics.svg").read_text()
    # One line of the truth in each of eight axes.
    assert sum(f'id="axes_{i}"' in text for i in range(1, 9)) == 8
    assert "<dc:date>" not in text


def test_without_a_full_identification_the_prior_is_considered():
    _, sweeps = measure_week(CELL, sigma=0.005, seed=0)
    result = identify_session(CELL, sweeps, SESSIONS[3], None, {"file": "a.h5"})
    assert result.estimate.data == {"file": "a.h5", "session": "extrinsic-day7"}
    assert result.fit.p_value > 1e-3


def test_a_folder_that_exists_is_used_again(weeks):
    assert (weeks[1] / "mine.txt").read_text() == "kept"


def test_the_circle_leaves_the_tolerance_when_the_papers_does(week):
    """The paper's circle is flat for 8 hours and departs after 10."""
    lines = [line.split() for line in (week / "report.txt").read_text().splitlines() if line.startswith(" check-")]
    peaks = {float(hours): float(peak) for _, _, hours, peak, _ in lines}
    assert tuple(peaks) == CHECK_HOURS
    assert peaks[0.0] < 10.0
    assert peaks[8.0] < 50.0 < peaks[14.0]
    for hours in (0, 14):
        trace = read_path_trace(week / "circles" / f"check-{hours:02d}h.csv", CELL)
        # Half a fringe is a full swing of the photodiode.
        swing = np.ptp(trace.irradiance[trace.path]) / np.ptp(trace.irradiance[trace.before])
        assert swing == pytest.approx(np.sin(4 * np.pi * 1e-3 * peaks[hours] / 1.56 / 2.0), abs=0.12)


def test_the_policy_holds_the_circle_where_the_papers_protocol_does_not(week):
    text = (week / "report.txt").read_text()
    shares = {}
    for name in ("the paper's protocol", "filter, the same sweeps", "policy"):
        line = next(line for line in text.splitlines() if line.startswith(f" {name}  "))
        shares[name] = float(line.removeprefix(f" {name}").split()[0])
    assert shares["policy"] > 95.0 > shares["filter, the same sweeps"] > shares["the paper's protocol"]


def test_the_policys_campaign_holds_its_track(week):
    campaign = read_campaign(week / "policy.h5", CELL)
    assert campaign.track is not None
    assert len(campaign.sweeps) - 69 <= 310
    estimate = read_estimate(week / "estimate.json", CELL)
    assert estimate.time_h == campaign.sweeps.time_h.max()
    assert estimate.valid_until_h > estimate.time_h


@pytest.mark.parametrize("name", ["campaign.h5", "policy.h5"])
def test_track_finds_nothing_new_in_its_campaigns(week, tmp_path, name):
    copy = tmp_path / name
    copy.write_bytes((week / name).read_bytes())
    out = tmp_path / "out.json"
    printed(["track", str(copy), "--json", str(out)])
    assert copy.read_bytes() == (week / name).read_bytes()
    assert json.loads(out.read_text())["calibration_due"] is False


def test_a_walk_goes_through_the_tables_with_the_drift_of_the_cell():
    steady = paper_truth(CELL)
    walks = [week_truth(CELL, "walk", seed) for seed in range(40)]
    for walk in walks[:3]:
        np.testing.assert_allclose(walk.at(steady.times_h), steady.values, rtol=0, atol=1e-9)
    position = steady.parameters.position("theta_et")
    steps = np.array([np.diff((walk.values - steady.at(walk.times_h))[:, position]) for walk in walks])
    size = DriftModel.of(CELL).sizes[CELL.free.position("theta_et")].walk
    # A bridge over six days wants for one degree of freedom in 288.
    assert steps.std() * np.sqrt(48.0) == pytest.approx(size, rel=0.02)
