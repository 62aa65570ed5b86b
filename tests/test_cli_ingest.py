"""The command ``ingest``: files in, files out, messages, exit status."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from trace_fixtures import record_all

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.files import write_json
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.recordings import write_recordings
from fpcal_bayes.io.sweeps import read_csv
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate


@pytest.fixture(scope="module")
def index(femto: Cell) -> TraceIndex:
    """A tilt, a spin, a translation along the optical axis and one across it."""
    truth = paper_truth(femto)
    sweeps = paper_protocol(femto).take(np.array([0, 5, 46, 48]))
    return record_all(femto, CavityModel.of(femto, truth.parameters), truth.at(0.0), sweeps, 11, 30.0)


@pytest.fixture
def spoilt(index: TraceIndex) -> TraceIndex:
    """The same with a spin that clips and a translation that slips."""
    traces = list(index.traces)
    traces[1] = replace(traces[1], irradiance=np.minimum(traces[1].irradiance, 2.0))
    return replace(index, traces=traces)


def test_ingest_writes_sweeps_and_json(
    tmp_path: Path, femto: Cell, index: TraceIndex, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recordings(tmp_path / "index.csv", index, femto)
    out = tmp_path / "sweeps.csv"
    assert main(["ingest", str(tmp_path / "index.csv"), "-o", str(out), "--json", str(tmp_path / "o.json")]) == 0
    sweeps = read_csv(out, femto)
    assert sweeps.label.tolist() == index.sweeps.label.tolist()
    assert "4 rows from 4 recordings" in capsys.readouterr().out
    content = json.loads((tmp_path / "o.json").read_text())
    assert content["schema"] == "fpcal/1"
    assert content["command"] == "ingest"
    assert content["counts"] == {"recordings": 4, "rows": 4, "doubtful": 0}
    assert content["warnings"] == []
    spin = content["sweeps"][1]
    assert spin["label"] == "node1-ry"
    assert spin["dl_um"] == pytest.approx(abs(sweeps.dl[1]), rel=1e-9)
    assert spin["signed"] == 0
    assert spin["doubtful"] is None
    truth = paper_truth(femto)
    model, row = CavityModel.of(femto, truth.parameters), index.sweeps
    q = row.q_start[1] + np.linspace(0, 1, 9001)[:, None] * (row.q_end[1] - row.q_start[1])
    lengths = model.predict(truth.at(0.0), model.pose_rows(q))
    assert spin["reversals"] == pytest.approx([90.0 * np.argmax(lengths) / 9000], abs=0.3)
    assert spin["fringes"] == pytest.approx(np.abs(np.diff(lengths)).sum() / 0.78, abs=0.02)
    assert content["sweeps"][2]["sign_from"] == "prior"
    assert not (tmp_path / "sweeps_doubtful").exists()


def test_doubtful_sweeps_are_left_out_of_a_csv_listed_and_drawn(
    tmp_path: Path, femto: Cell, spoilt: TraceIndex, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recordings(tmp_path / "index.h5", spoilt, femto)
    out, report = tmp_path / "sweeps.csv", tmp_path / "o.json"
    assert main(["ingest", str(tmp_path / "index.h5"), "-o", str(out), "--json", str(report)]) == 0
    assert len(read_csv(out, femto)) == 3
    said = capsys.readouterr()
    assert "1 doubtful, left out, drawn in" in said.out
    assert re.search("warning: node1-ry: refused: saturated", said.err)
    picture = tmp_path / "sweeps_doubtful" / "0002.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    content = json.loads(report.read_text())
    assert content["sweeps"][1]["dl_um"] is None
    assert content["sweeps"][1]["doubtful"].startswith("refused: saturated")
    assert content["warnings"] == [f"node1-ry: {content['sweeps'][1]['doubtful']}"]


def test_who_measured_with_what_travels_with_the_campaign(tmp_path: Path, femto: Cell, index: TraceIndex) -> None:
    write_recordings(tmp_path / "index.h5", index, femto)
    out = tmp_path / "campaign.h5"
    assert (
        main(["ingest", str(tmp_path / "index.h5"), "-o", str(out), "--about", "A. Name; q1 S/N 7 & <8>", "--quiet"])
        == 0
    )
    assert read_campaign(out, femto).about == "A. Name; q1 S/N 7 & <8>"


def test_the_gain_is_spoken_of_once(
    tmp_path: Path, femto: Cell, index: TraceIndex, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = [replace(trace, irradiance=np.minimum(trace.irradiance, 2.0)) for trace in index.traces]
    write_recordings(tmp_path / "index.h5", replace(index, traces=cut), femto)
    assert main(["ingest", str(tmp_path / "index.h5"), "-o", str(tmp_path / "sweeps.csv"), "--no-plots"]) in (0, 2)
    err = capsys.readouterr().err
    assert err.count("lower the gain") == 1
    assert f"{len(cut)} sweeps (" in err


def test_a_campaign_keeps_doubtful_sweeps_and_traces_and_other_commands_take_it(
    tmp_path: Path, femto: Cell, spoilt: TraceIndex
) -> None:
    write_recordings(tmp_path / "index.csv", spoilt, femto)
    out = tmp_path / "campaign.h5"
    assert main(["ingest", str(tmp_path / "index.csv"), "-o", str(out), "--no-plots", "--points", "2"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["campaign.h5", "index.csv", "index_traces"]
    kept = read_campaign(out, femto)
    assert len(kept.sweeps) == 9
    assert kept.doubtful is not None
    assert kept.doubtful.label.tolist() == ["node1-ry"]
    assert kept.recordings is not None
    assert len(kept.recordings) == 4
    assert kept.command == "fpcal ingest index.csv --points 2"
    # The campaign can be read anew, now with what an estimate knows.
    estimate, again = tmp_path / "e.json", tmp_path / "again.csv"
    truth = paper_truth(femto)
    values = truth.at(0.0)
    known = Estimate(
        femto, truth.parameters, values, 1e-10 * np.eye(len(values)), ("identified",) * len(values)
    ).content()
    write_json(estimate, {"schema": "fpcal/1", **known})
    assert main(["ingest", str(out), "-o", str(again), "--estimate", str(estimate), "--no-plots"]) == 0
    assert read_csv(again, femto).signed.all()
    # What saves its own results in a campaign leaves the traces where they are.
    write_campaign(tmp_path / "copy.h5", kept, femto)
    assert (tmp_path / "copy.h5").read_bytes() == out.read_bytes()


def broken(folder: Path, femto: Cell, index: TraceIndex, edit) -> str:  # type: ignore[no-untyped-def]
    write_recordings(folder / "index.csv", index, femto)
    edit(folder)
    return str(folder / "index.csv")


def rewrite(name: str, old: str, new: str):  # type: ignore[no-untyped-def]
    def edit(folder: Path) -> None:
        text = (folder / name).read_text()
        assert re.search(old, text)
        (folder / name).write_text(re.sub(old, new, text, count=1))

    return edit


def drop(folder: Path) -> None:
    (folder / "index_traces" / "2.csv").unlink()


T_S = r"index_traces/1\.csv: row 3, column t_s: expected a "


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            rewrite("index_traces/1.csv", r"\n0\.0[^0,][^,]*,", "\nnan,"),
            r"1\.csv: row 3, column t_s: expected a number",
        ),
        (
            rewrite("index_traces/1.csv", r"\n0\.0[^0,][^,]*,", "\n-9,"),
            r"1\.csv: row 3, column t_s: expected a time later",
        ),
        (rewrite("index_traces/3.csv", r"\n0.0,-20.0,", "\n0.0,-12.0,"), "3.csv: column joint: the start at -12 um"),
        (drop, r"index\.csv: row 3, column trace: 'index_traces/2\.csv': no such file"),
        (rewrite("index.csv", "index_traces/1.csv", "../index_traces/1.csv"), "expected a path inside the folder"),
        (rewrite("index.csv", "node0-rx,0,0,0,-3", "node0-rx,0,0,0,-30"), "row 2, column q4_start_deg: -30 deg"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(
    tmp_path: Path, femto: Cell, index: TraceIndex, capsys: pytest.CaptureFixture[str], edit, message: str
) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out.h5"
    assert main(["ingest", broken(tmp_path, femto, index, edit), "-o", str(out)]) == 2
    said = capsys.readouterr().err
    assert re.search(message, said)
    assert len(said.strip().splitlines()) == 1
    assert not out.exists()


def test_outputs_are_looked_at_before_any_work(
    tmp_path: Path, femto: Cell, index: TraceIndex, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recordings(tmp_path / "index.h5", index, femto)
    source = str(tmp_path / "index.h5")
    before = (tmp_path / "index.h5").read_bytes()
    for output, message in (
        (source, "is an input of this command"),
        (str(tmp_path / "out.txt"), "expected a file name that ends in .csv"),
        (str(tmp_path / "none" / "out.csv"), "does not exist"),
    ):
        assert main(["ingest", source, "-o", output]) == 2
        assert message in capsys.readouterr().err
    same = str(tmp_path / "out.csv")
    assert main(["ingest", source, "-o", same, "--json", same]) == 2
    assert (tmp_path / "index.h5").read_bytes() == before
