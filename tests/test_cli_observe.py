"""The command ``fpcal observe``."""

import json
from pathlib import Path

import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.protocol import paper_protocol

CELL = load_cell(mechanics="none")
CASE_A = str(Path(__file__).parent / "data" / "case_a.csv")


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("plan") / "plan.csv"
    write_csv(path, paper_protocol(CELL), CELL)
    return str(path)


def refused(arguments, capsys) -> str:
    """The single line of an error with exit status 2."""
    assert main(["observe", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("fpcal: error: ")
    return line


def test_json_of_measured_sweeps(tmp_path, capsys):
    out = tmp_path / "out.json"
    assert main(["observe", CASE_A, "--json", str(out)]) == 0
    content = json.loads(out.read_text())
    assert (content["schema"], content["command"]) == ("fpcal/1", "observe")
    found = content["observability"]
    assert {"rank", "n_parameters", "tolerance", "singular_values", "indices", "condition", "gauges"} <= set(found)
    assert {"base_parameters", "blocks"} <= set(found)
    assert (found["rank"], found["n_parameters"]) == (16, 21)
    assert len(found["singular_values"]) == 21
    assert sum(s > found["tolerance"] for s in found["singular_values"]) == 16
    assert list(found["indices"]) == ["O1", "O2", "O3", "O4", "O5"]
    assert found["condition"] == pytest.approx(found["singular_values"][0] / found["singular_values"][15])
    assert len(found["gauges"]) == 5
    for gauge in found["gauges"]:
        assert len(gauge["parameters"]) == len(gauge["direction"])
        assert gauge["explanation"]
    assert len(found["base_parameters"]) == 16
    assert {"all", "rotations", "translations", "all, midpoints", "all, absolute length"} <= {
        block["name"] for block in found["blocks"]
    }
    entry = content["parameters"]["theta_6"]
    assert (entry["status"], entry["unit"], entry["prior_sd"]) == ("gauge", "deg", 1.0)
    assert content["fit"]["n_sweeps"] == 69
    assert content["fit"]["converged"] is True
    assert content["covariance"]["names"] == list(content["parameters"])
    assert found["bounds"]["full"]["y_wf"]["unbiased"] is None
    captured = capsys.readouterr()
    assert "16 of 21 combinations are seen" in captured.out
    assert captured.err.startswith("fpcal: warning: with q6, or q3 and q5, or q1 and q4 counted")


def test_a_plan_needs_no_measurement(plan, tmp_path, capsys):
    out = tmp_path / "out.json"
    assert main(["observe", plan, "--json", str(out), "--sigma-nm", "50"]) == 0
    coarse = json.loads(out.read_text())
    assert main(["observe", plan, "--json", str(out)]) == 0
    fine = json.loads(out.read_text())
    assert coarse["observability"]["rank"] == fine["observability"]["rank"] == 16
    ratio = fine["observability"]["singular_values"][0] / coarse["observability"]["singular_values"][0]
    assert ratio == pytest.approx(10.0)
    assert fine["fit"] == {"n_sweeps": 69, "rank": 16}
    assert "expected sd" in capsys.readouterr().out


def test_quiet_and_perpendicular(plan, tmp_path, capsys):
    out = tmp_path / "out.json"
    assert main(["observe", plan, "--quiet", "--opd", "perpendicular", "--json", str(out)]) == 0
    assert capsys.readouterr().out == ""
    content = json.loads(out.read_text())
    assert content["observability"]["rank"] == 14
    assert content["parameters"]["beta_wf"]["status"] == "gauge"


def test_candidates(plan, tmp_path, capsys):
    few, out = tmp_path / "few.csv", tmp_path / "out.json"
    write_csv(few, paper_protocol(CELL).take(paper_protocol(CELL).label == "orient3-3-0-tz"), CELL)
    assert main(["observe", CASE_A, "--candidates", str(few), "--json", str(out)]) == 0
    candidates = json.loads(out.read_text())["information"]["candidates"]
    assert [c["label"] for c in candidates] == ["orient3-3-0-tz"]
    assert candidates[0]["bits"] > 0.1
    assert "Best additions, each counted alone: orient3-3-0-tz (+" in capsys.readouterr().out


def test_html(tmp_path, capsys):
    page = tmp_path / "page.html"
    assert main(["observe", CASE_A, "--html", str(page), "--quiet"]) == 0
    assert page.read_text().startswith("<!DOCTYPE html>")


def test_bad_input_is_one_line(plan, tmp_path, capsys):
    missing = str(tmp_path / "none.csv")
    assert "no such file" in refused([missing], capsys)
    assert "no session 'x'" in refused([CASE_A, "--session", "x"], capsys)
    assert "does not exist" in refused([CASE_A, "--html", str(tmp_path / "no" / "page.html")], capsys)
    assert "does not exist" in refused([CASE_A, "--json", str(tmp_path / "no" / "out.json")], capsys)
    assert "is an input of this command" in refused([plan, "--html", plan], capsys)
    assert "no such file" in refused([CASE_A, "--candidates", missing], capsys)
    broken = tmp_path / "broken.csv"
    broken.write_text(Path(plan).read_text().replace("node3-rx,", "node3-rx,far", 1))
    line = refused([str(broken)], capsys)
    assert "broken.csv" in line
    assert "row 11" in line
    assert "column q1_start_um" in line


def test_an_html_file_is_not_left_half_written(tmp_path, capsys):
    page = tmp_path / "page.html"
    refused([CASE_A, "--html", str(page), "--session", "x"], capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "option", [["--sigma-nm", "0"], ["--sigma-nm", "x"], ["--weak-share", "1"], ["--weak-share", "-1"]]
)
def test_bad_options(option, capsys):
    try:
        status = main(["observe", CASE_A, *option])
    except SystemExit as leaving:
        status = leaving.code
    assert status == 2
    assert "expected a number" in capsys.readouterr().err
