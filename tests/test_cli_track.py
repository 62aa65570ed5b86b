"""The command ``fpcal track``."""

import contextlib
import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from track_fixtures import CELL, campaign, knock

from fpcal_bayes.analysis.watch import watch
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.files import exclusive, file_sha256
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import write_sweeps

TRUTH, SWEEPS = campaign(5, sessions=4, change=knock(np.random.default_rng(0)), changed=3)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def written(name: str, *sessions: str, **changes) -> str:
    sweeps = replace(SWEEPS, **changes)
    write_sweeps(name, sweeps.take(np.isin(sweeps.session, ["day0", *sessions])) if sessions else sweeps, CELL)
    return name


def refused(capsys, *arguments: str) -> str:
    assert main(["track", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


def test_json_and_estimate(capsys):
    file = written("week.csv")
    before = file_sha256(Path(file))
    assert main(["track", file, "--json", "out.json", "--estimate", "estimate.json"]) == 0
    assert file_sha256(Path(file)) == before
    content = json.loads(Path("out.json").read_text())
    assert (content["schema"], content["command"], content["time_h"]) == ("fpcal/1", "track", 32.0)
    sessions = content["sessions"]
    assert [s["session"] for s in sessions] == ["day0", "s1", "s2", "s3", "s4"]
    assert {"session", "time_h", "n_sweeps", "nis", "dof", "verdict"} <= set(sessions[0])
    assert [s["verdict"] for s in sessions[1:]] == ["as-modelled", "as-modelled", "extrinsics-moved", "as-modelled"]
    assert [s["dof"] for s in sessions[1:]] == [6, 6, 6, 6]
    assert sessions[3]["nis"] > 100
    assert content["data"]["sha256"] == before
    assert any(text.startswith("s3: extrinsics-moved: ") for text in content["warnings"])
    estimate = read_estimate("estimate.json", CELL)
    assert estimate.time_h == 32.0
    assert estimate.parameters.names == CELL.free.names
    for name, entry in content["parameters"].items():
        assert entry["value"] == pytest.approx(estimate.shown()[name]["value"], rel=1e-12)
    x_wf = estimate.parameters.position("x_wf")
    assert abs(estimate.values[x_wf] - TRUTH.at(32.0)[x_wf]) < 5 * estimate.sd[x_wf]
    out, err = capsys.readouterr()
    assert "extrinsics-moved" in out
    assert "s3: extrinsics-moved: " in err


def test_a_campaign_file_keeps_the_states(capsys):
    file = written("week.h5", "s1", "s2")
    assert main(["track", file, "--quiet"]) == 0
    saved = read_campaign(file, CELL)
    assert saved.track.mean.shape == (3, 21)
    sweeps = SWEEPS.take(np.isin(SWEEPS.session, ["day0", "s1", "s2", "s3"]))
    from fpcal_bayes.io.campaign import write_campaign

    write_campaign(file, replace(saved, sweeps=sweeps), CELL)
    assert main(["track", file]) == 0
    assert "4 sessions, 3 known before" in capsys.readouterr().out
    before = file_sha256(Path(file))
    assert main(["track", file]) == 0
    assert "4 sessions, 4 known before" in capsys.readouterr().out
    assert file_sha256(Path(file)) == before
    assert main(["track", file, "--opd", "perpendicular"]) == 2
    assert "of another cell or path model" in capsys.readouterr().err
    assert main(["track", file, "--anew", "--json", "anew.json"]) == 0
    assert "4 sessions, 0 known before" in capsys.readouterr().out


def test_clock_times_are_shown(capsys):
    utc = [f"2024-05-{1 + int(hour) // 24:02d}T{int(hour) % 24:02d}:00:00Z" for hour in SWEEPS.time_h]
    file = written("week.csv", utc=np.array(utc))
    assert main(["track", file, "--now", "2024-05-02T09:00:00Z", "--estimate", "estimate.json"]) == 0
    assert "2024-05-02 08:00 UTC" in capsys.readouterr().out
    # By it a controller tells from its clock whether the estimate still holds.
    assert json.loads(Path("estimate.json").read_text())["data"]["utc"] == "2024-05-02T08:00:00Z"
    line = refused(capsys, file, "--now", "2024-05-02T07:00:00Z")
    assert "session s4 lies in the future" in line


def test_what_is_refused(capsys):
    file = written("week.csv")
    assert "expected two names" in refused(capsys, file, "--json", "a.json", "--estimate", "a.json")
    assert "is an input of this command" in refused(capsys, file, "--json", file)
    write_sweeps("few.csv", SWEEPS.take(SWEEPS.session != "day0"), CELL)
    assert "is no calibration" in refused(capsys, "few.csv")
    text = CELL_FILE.read_text().split("[extrinsic.drift]")[0]
    Path("still.toml").write_text("\n".join(line for line in text.splitlines() if not line.startswith("drift = ")))
    assert "states no drift" in refused(capsys, file, "--cell", "still.toml")


def test_a_reader_never_sees_half_an_estimate():
    file = written("week.csv", "s1")
    assert main(["track", file, "--quiet", "--estimate", "estimate.json"]) == 0
    done, failures = threading.Event(), []

    def read() -> None:
        while not done.is_set():
            try:
                read_estimate("estimate.json", CELL)
            except Exception as error:
                failures.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(5):
        main(["track", file, "--quiet", "--estimate", "estimate.json"])
    done.set()
    reader.join()
    assert not failures


CELL_FILE = Path(__file__).parents[1] / "data" / "femto-st.toml"


def test_watching_takes_in_each_new_session(monkeypatch, capsys):
    arrivals, held = iter(["s1", "half", "s2", None]), []
    written("week.csv", "s1")

    def sleep(seconds):
        assert seconds == 5.0
        arrived = next(arrivals)
        held.append(read_estimate("estimate.json", CELL).time_h)
        if arrived is None:
            raise KeyboardInterrupt
        if arrived == "half":
            Path("week.csv").write_text("session,time_h\nday0")
        if arrived == "s2":
            written("week.csv", "s1", "s2")

    monkeypatch.setattr("fpcal_bayes.analysis.watch.time.sleep", sleep)
    assert main(["track", "week.csv", "--estimate", "estimate.json", "--watch", "5"]) == 0
    assert held == [8.0, 8.0, 8.0, 16.0]
    out, err = capsys.readouterr()
    assert "looking again in 5 s" in err
    assert out.count("week.csv: ") == 2


class Watched:
    """What happens between looks, one after the other, and then an interruption."""

    def __init__(self, *steps):
        self.steps, self.said, self.taken = iter(steps), [], []

    def __call__(self, seconds):
        step = next(self.steps, None)
        if step is None:
            raise KeyboardInterrupt
        step()

    def run(self, monkeypatch, file, take_in):
        monkeypatch.setattr("fpcal_bayes.analysis.watch.time.sleep", self)

        def take(again):
            take_in(again)
            self.taken.append(again)

        with pytest.raises(KeyboardInterrupt):
            watch(file, 5.0, take, self.said.append)


def nothing():
    pass


@pytest.mark.parametrize(
    "error",
    [np.linalg.LinAlgError("Singular"), MemoryError(), RecursionError("deep"), OverflowError(), OSError(5, "EIO")],
)
def test_watching_survives_every_error_and_says_it_once(error, monkeypatch):
    failing, file = [True], Path("week.csv")

    def take_in(again):
        if failing[0]:
            raise error

    watched = Watched(*[nothing] * 20, lambda: failing.clear() or failing.append(False), *[nothing] * 9)
    file.write_text("a")
    watched.run(monkeypatch, file, take_in)
    assert len(watched.said) == 1
    assert "; looking again in 5 s" in watched.said[0]
    # Tried again though the file is as it was, and done once.
    assert watched.taken == [False]


def test_watching_waits_for_a_campaign_that_is_not_there_or_held(monkeypatch, capsys):
    held = contextlib.ExitStack()

    def arrives():
        written("week.h5", "s1")
        held.enter_context(exclusive(Path("week.h5")))

    steps = iter([nothing, nothing, arrives, nothing, nothing, held.close, *[nothing] * 9])

    def sleep(seconds):
        step = next(steps, None)
        if step is None:
            raise KeyboardInterrupt
        step()

    monkeypatch.setattr("fpcal_bayes.analysis.watch.time.sleep", sleep)
    assert main(["track", "week.h5", "--estimate", "now.json", "--watch", "5"]) == 0
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if "looking again" in line]
    assert len(lines) == 2
    assert "week.h5: no such file; looking again in 5 s" in lines[0]
    assert "another fpcal is writing this file" in lines[1]
    assert read_estimate("now.json", CELL).time_h == 8.0
    assert out.count("week.h5: ") == 1
    assert read_campaign("week.h5", CELL).track is not None
