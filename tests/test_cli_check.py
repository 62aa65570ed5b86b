"""``fpcal simulate --traces`` and ``fpcal check``."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from test_cli_control import refusal, run

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.io.sweeps import read_csv, write_csv
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.model.cell.cell import Cell


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An estimate of the true cell, the joint path of a circle, and recordings of it after 0, 8 and 192 hours."""
    folder = tmp_path_factory.mktemp("check")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in (
            ["simulate", "-o", "s.csv"],
            ["identify", "s.csv", "--json", "e.json"],
            ["control", "--estimate", "e.json", "--task", "circle", "-o", "circle.csv"],
            *(
                ["simulate", "--path", "circle.csv", "--traces", "--time-h", hours, "-o", f"t{hours}.csv"]
                for hours in ("0", "8", "192")
            ),
        ):
            assert main([*command, "--quiet"]) == 0
    return folder


@pytest.fixture(autouse=True)
def here(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Every test starts in a folder of its own with these files."""
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()


def short_plan(cell: Cell) -> None:
    write_csv("plan.csv", paper_protocol(cell).take(np.array([0, 46, 47])), cell)


class TestSimulateTraces:
    @pytest.mark.parametrize("suffix", ["csv", "h5"])
    def test_an_index_is_written_that_reads_back_and_is_the_same_again(
        self, femto: Cell, suffix: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        short_plan(femto)
        digests = []
        for name in ("a", "b"):
            run("simulate", "-o", f"{name}.{suffix}", "--traces", "--protocol", "plan.csv", "--seed", 3)
            files = [Path(f"{name}.{suffix}"), *sorted(Path(f"{name}_traces").glob("*"))]
            content = [file.read_bytes().replace(f"{name}_traces".encode(), b"") for file in files]
            digests.append(hashlib.sha256(b"".join(content)).hexdigest())
        assert digests[0] == digests[1]
        assert "3 sweeps recorded on cell 'femto-st', 6003 samples -> a." in capsys.readouterr().out
        index = read_recordings(f"a.{suffix}", femto)
        assert [len(trace) for trace in index.traces] == [2001] * 3
        assert all(scan is not None for scan in index.scans_before + index.scans_after)
        # The truth beside it is one that the command takes again.
        run("simulate", "-o", "again.csv", "--truth", "a_truth.toml", "--quiet")
        assert Path("again.csv").read_bytes() == Path("s.csv").read_bytes()

    def test_scans_where_the_paper_has_them(self, femto: Cell) -> None:
        short_plan(femto)
        run("simulate", "-o", "a.csv", "--traces", "--protocol", "plan.csv", "--signs", "paper", "--quiet")
        index = read_recordings("a.csv", femto)
        assert [scan is not None for scan in index.scans_after] == [False, False, True]

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["--path", "circle.csv"], "--path: is taken with --traces only"),
            (["--traces", "--sigma-nm", "3"], "--sigma-nm: is not taken with --traces"),
            (["--traces", "--time-h", "3"], "--time-h: is taken with --path only"),
            (["--traces", "--path", "circle.csv", "--protocol", "paper"], "--protocol: is not taken with --path"),
            (["--traces", "--protocol", "paper-mid"], "column group: expected no group"),
            (["--traces", "--path", "none.csv"], "none.csv: no such file"),
            (["--traces", "--path", "e.json"], "e.json: row 1: expected the header q1_um"),
        ],
    )
    def test_refusals(self, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
        assert message in refusal(capsys, "simulate", "-o", "new.csv", *options)
        assert not Path("new.csv").exists()


class TestCheck:
    def test_a_fresh_calibration_is_confirmed(self, capsys: pytest.CaptureFixture[str]) -> None:
        run("check", "t0.csv", "--estimate", "e.json", "--tolerance-nm", 50, "--json", "c.json")
        out = capsys.readouterr().out
        assert "The calibration is confirmed on the cell" in out
        assert "The path is within 50 nm peak to peak" in out
        written = json.loads(Path("c.json").read_text())
        assert (written["schema"], written["command"]) == ("fpcal/1", "check")
        check = written["check"]
        assert check["verdict"] == "confirmed"
        assert check["peak_to_peak_nm"] < 10.0
        assert check["within_tolerance_probability"] == 1.0
        # End points alone cannot tell which way some axes count; nothing else is held against the calibration.
        assert [text for text in written["warnings"] if "counted the other way" not in text] == []

    def test_a_stale_one_is_refuted_unless_it_may_drift(self, capsys: pytest.CaptureFixture[str]) -> None:
        run("check", "t8.csv", "--estimate", "e.json")
        assert "The calibration is refuted on the cell" in capsys.readouterr().out
        run("check", "t8.csv", "--estimate", "e.json", "--time-h", 8)
        assert "The calibration is confirmed on the cell" in capsys.readouterr().out

    def test_rows_for_a_campaign_that_the_tracker_takes(self, femto: Cell, capsys: pytest.CaptureFixture[str]) -> None:
        run(
            "check", "t8.csv", "--estimate", "e.json", "-o", "rows.csv", "--points", 6, "--time-h", 8,
            "--session", "check-8h", "--quiet",
        )  # fmt: skip
        rows = read_csv("rows.csv", femto)
        assert rows.kind.tolist() == ["path"] + 6 * ["sweep"]
        assert set(rows.session) == {"check-8h"}
        assert rows.dl[0] == pytest.approx(0.037, abs=0.004)
        old, new = Path("s.csv").read_text().splitlines(), Path("rows.csv").read_text().splitlines()
        Path("campaign.csv").write_text("\n".join([new[0], *(line + ",,sweep," for line in old[1:]), *new[1:]]) + "\n")
        capsys.readouterr()
        run("track", "campaign.csv", "--json", "track.json", "--quiet")
        sessions = json.loads(Path("track.json").read_text())["sessions"]
        assert sessions[1]["n_sweeps"] == 6
        assert sessions[1]["verdict"] == "as-modelled"

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["t8.csv", "--estimate", "none.json"], "none.json: no such file"),
            (["none.csv", "--estimate", "e.json"], "none.csv: no such file"),
            (["s.csv", "--estimate", "e.json"], "s.csv: row 1: expected the header part,t_s,q1_um"),
            (["t8.csv", "--estimate", "e.json", "--points", "3"], "--points: is taken with -o only"),
            (["t8.csv", "--estimate", "e.json", "--time-h", "-3"], "--time-h -3: expected a time after"),
            (["t8.csv", "--estimate", "e.json", "--temperature-c", "20"], "expected all three or none"),
            (["t8.csv", "--estimate", "e.json", "-o", "t8.csv"], "t8.csv: is an input of this command"),
            (["t8.csv", "--estimate", "e.json", "--opd", "perpendicular"], "the estimate is of another cell"),
        ],
    )
    def test_refusals(self, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
        assert message in refusal(capsys, "check", *options)
