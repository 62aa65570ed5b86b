import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.measure.campaign import read_campaign
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cell import load_cell
from fpcal_bayes.model.estimate import read_estimate
from fpcal_bayes.week import SESSIONS, identify_session, measure_week

pytestmark = pytest.mark.slow

CELL = load_cell()
NAMES = [session.name for session in SESSIONS]


@pytest.fixture(scope="module")
def weeks(tmp_path_factory) -> list[Path]:
    """The week, run twice."""
    folders = [tmp_path_factory.mktemp("week") / name for name in ("first", "second")]
    for folder in folders:
        assert main(["week", "-o", str(folder), "--quiet", "--seed", "3"]) == 0
    return folders


@pytest.fixture(scope="module")
def week(weeks) -> Path:
    return weeks[0]


@pytest.fixture(scope="module")
def estimates(week) -> dict[str, dict]:
    return {name: json.loads((week / f"{name}.json").read_text()) for name in NAMES}


def test_files(week):
    expected = {"campaign.h5", "report.txt", "posterior.nc", "extrinsics.svg", *(f"{name}.json" for name in NAMES)}
    assert {path.name for path in week.iterdir()} == expected


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


def test_warnings_name_their_session(tmp_path, capsys):
    assert main(["week", "-o", str(tmp_path / "week"), "--seed", "3"]) == 0
    out, err = capsys.readouterr()
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


def test_campaign_holds_everything(week, estimates):
    campaign = read_campaign(week / "campaign.h5", CELL)
    assert campaign.command == "fpcal week --sigma-nm 5 --seed 3"
    assert campaign.seed == 3
    assert list(campaign.sweeps.sessions) == NAMES
    assert len(campaign.sweeps) == 5 * 69
    assert campaign.truth is not None
    assert campaign.truth.times_h.tolist() == [0.0, 24.0, 48.0, 192.0]
    assert set(campaign.estimates) == set(NAMES)
    for name, stored in campaign.estimates.items():
        told = {key: value for key, value in estimates[name].items() if key != "fit"}
        assert {key: value for key, value in stored.items() if key != "fit"} == told
        assert stored["fit"] == {key: value for key, value in estimates[name]["fit"].items() if key != "seconds"}


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
    for path in sorted(weeks[0].iterdir()):
        contents = [path.read_bytes(), (weeks[1] / path.name).read_bytes()]
        if path.suffix == ".json":
            found = [json.loads(content) for content in contents]
            for content in found:
                assert content["fit"].pop("seconds") > 0
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


def test_a_folder_that_exists_is_used_again(week, tmp_path, capsys):
    folder = tmp_path / "week"
    folder.mkdir()
    (folder / "mine.txt").write_text("kept")
    assert main(["week", "-o", str(folder), "--quiet", "--sigma-nm", "2"]) == 0
    assert (folder / "mine.txt").read_text() == "kept"
    assert capsys.readouterr().out == ""
    sigma = read_campaign(folder / "campaign.h5", CELL).sweeps.sigma
    np.testing.assert_allclose(sigma, 0.002, rtol=1e-12)
