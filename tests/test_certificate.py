"""The hand-over: certificate, calibrated chain, compensation tables."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.analysis.motions import axis_tables, motion_curves
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.files import content_sha256, file_sha256
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.model import chain


def run(line: str) -> None:
    assert main([*line.split(), "--mechanics", "stated", "--quiet"]) == 0


@pytest.fixture(scope="module")
def handed(tmp_path_factory) -> Path:
    """A calibration of a machine, handed over."""
    folder = tmp_path_factory.mktemp("hand")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run("simulate -o s.csv --protocol paper-mid --seed 3")
        run("identify s.csv --json e.json")
        run("certificate e.json -o out")
    return folder


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as handle:
        return list(csv.DictReader(handle))


def test_the_certificate_holds_together(handed):
    said = json.loads((handed / "out" / "certificate.json").read_text())
    assert (said["schema"], said["command"], said["trust"]["usable"]) == ("fpcal/1", "certificate", True)
    assert said.pop("content_sha256") == content_sha256(said)
    found = said["certificate"]
    assert found["calibrated"]
    assert found["estimate"]["sha256"] == file_sha256(handed / "e.json")
    for name, file in found["files"].items():
        assert file["sha256"] == file_sha256(handed / "out" / name)
    assert set(found["files"]) == {"chain.csv", *(f"q{i}.csv" for i in range(1, 7))}
    estimate = json.loads((handed / "e.json").read_text())
    assert list(said["parameters"]) == list(estimate["parameters"])
    for name, one in estimate["parameters"].items():
        assert said["parameters"][name] == {**one, "sd": pytest.approx(one["sd"], rel=1e-12)}
    assert found["tasks"]["tilt-x"]["freedoms"]["rx"]["peak_to_peak_deg"]["high"] > 0


def test_the_chain_is_that_of_the_estimate(handed):
    """The tool's pose from the table alone, by the transforms of Khalil and Kleinfinger written out here."""
    cell = load_cell(mechanics="stated")
    estimate, q = read_estimate(handed / "e.json", cell), np.array([10.0, -20.0, 30.0, 0.02, -0.03, 0.7])

    def turn(axis: int, angle: float) -> np.ndarray:
        made, (i, j) = np.eye(4), ((1, 2), (2, 0), (0, 1))[axis]
        made[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        return made

    pose = np.eye(4)
    for row, value in zip(rows(handed / "out" / "chain.csv"), q, strict=True):
        beta, alpha, theta = (np.radians(float(row[f"{name}_deg"])) for name in ("beta", "alpha", "theta"))
        d, r = float(row["d_um"]), float(row["r_um"])
        r, theta = (r + value, theta) if row["kind"] == "prismatic" else (r, theta + value)
        pose = pose @ turn(1, beta) @ turn(0, alpha) @ chain.translation(d, 0, 0) @ turn(2, theta)
        pose = pose @ chain.translation(0, 0, r)
    np.testing.assert_allclose(pose, chain.tool_pose(cell, estimate.vector(), q), atol=1e-7)
    sd = estimate.shown()["alpha_2"]["sd"]
    assert float(rows(handed / "out" / "chain.csv")[1]["alpha_sd_deg"]) == pytest.approx(sd)


def test_error_motions_have_the_names_of_iso_230(handed):
    estimate = read_estimate(handed / "e.json", load_cell(mechanics="stated"))
    curves = {curve.name: curve for curve in motion_curves(estimate)}
    tables = axis_tables(estimate)
    # q1 moves along +Z: own axis Z, upward Y, across Z x Y = -X; q6 turns about Y.
    assert {name[:3] for name in tables[0]} - {"q1_"} == {"EXZ", "EYZ", "EZZ", "EAZ", "EBZ", "ECZ"}
    assert {name[:3] for name in tables[5]} - {"q6_"} == {"EXB", "EYB", "EZB", "EAB", "EBB", "ECB"}
    np.testing.assert_allclose(tables[0]["EXZ_nm"], -curves["straightness of q1"].middle)
    np.testing.assert_allclose(tables[0]["EXZ_low_nm"], -curves["straightness of q1"].high)
    np.testing.assert_allclose(tables[0]["EYZ_nm"], curves["flatness of q1"].middle)
    np.testing.assert_allclose(tables[0]["ECZ_high_urad"], curves["roll of q1"].high)
    (first, *_) = rows(handed / "out" / "q1.csv")
    assert float(first["q1_um"]) == -150.0
    assert float(first["EZZ_nm"]) == pytest.approx(tables[0]["EZZ_nm"][0])


def test_what_is_past_its_time_is_no_calibration(handed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    content = json.loads((handed / "e.json").read_text())
    content.pop("content_sha256")
    content |= {"valid_until_h": 8.0, "data": content["data"] | {"utc": "2026-01-01T00:00:00Z"}}
    Path("old.json").write_text(json.dumps(content))
    run("certificate old.json -o then --now 2026-01-01T02:00:00Z")
    found = json.loads(Path("then/certificate.json").read_text())["certificate"]
    assert (found["calibrated"], found["valid_until_utc"]) == (True, "2026-01-01T08:00:00.000Z")
    capsys.readouterr()
    run("certificate old.json -o now --now 2026-01-02T02:00:00Z")
    assert "was valid until 8.00 h, which has passed" in capsys.readouterr().err
    said = json.loads(Path("now/certificate.json").read_text())
    assert (said["certificate"]["calibrated"], said["valid_until_h"]) == (False, None)
    assert said["certificate"]["tasks"]["circle"]["peak_to_peak_nm"]["high"] is None
    assert set(said["certificate"]["files"]) == {"chain.csv"}
    assert {row["alpha_sd_deg"] for row in rows(Path("now/chain.csv"))} == {""}
    # A folder that cannot be made is said in one line, and nothing is written.
    Path("taken").write_text("")
    assert main(["certificate", "old.json", "-o", "taken", "--mechanics", "stated", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "taken" in line
