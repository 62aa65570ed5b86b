import contextlib
import json
import sys

import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.study import runner


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_study_of_two_weeks(tmp_path, capsys, monkeypatch):
    """Through the command line, stopped after one replicate and taken up; then with nothing left to do."""
    distributed = pytest.importorskip("distributed")

    @contextlib.contextmanager
    def one_thread(scheduler, workers):
        # Workers that are processes are tested with the runner; they take seconds to start.
        settings = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
        with distributed.LocalCluster(processes=False, **settings) as cluster, distributed.Client(cluster) as client:
            yield client

    monkeypatch.setattr(runner, "connected", one_thread)
    store, out = tmp_path / "weeks.h5", tmp_path / "weeks.json"
    command = ["study", "policy", "--policies", "never", "--hours", "2", "--workers", "1", "-o", str(store)]
    assert main([*command, "--replicates", "1", "--quiet"]) == 0
    assert main([*command, "--replicates", "2", "--json", str(out)]) == 0
    assert "1 were there before" in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert content["schema"] == "fpcal/1"
    assert content["command"] == "study"
    assert (content["study"], content["replicates"]) == ("policy", 2)
    (row,) = content["rows"]
    assert row["policy"] == "never"
    assert row["sweeps"] == 0.0
    before = store.read_bytes()
    assert main([*command, "--replicates", "2"]) == 0
    assert "0 replicates in" in capsys.readouterr().out
    assert store.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["magic", "--replicates", "3"], "invalid choice"),
        (["coverage"], "--replicates"),
        (["coverage", "--replicates", "0"], "above zero"),
        (["coverage", "--replicates", "3", "--workers", "2", "--scheduler", "tcp://127.0.0.1:9"], "--workers"),
        (["coverage", "--replicates", "3", "--protocol", "missing.csv"], "missing.csv: no such file"),
        (["sbc", "--replicates", "3", "--draws", "100"], "--draws 100: expected more than 199"),
        (["plan", "--replicates", "3"], "expected --plan SWEEPS"),
        (["policy", "--replicates", "3", "--policies", "wishful"], "'wishful' is unknown, expected some of: never;"),
        (["policy", "--replicates", "3", "--policies", "never", "-o", "no/where.h5"], "folder no does not exist"),
    ],
)
def test_wrong_usage_is_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["study", *arguments]) == 2
    text = capsys.readouterr().err
    assert message in text
    assert len(text.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_without_dask(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["study", "policy", "--replicates", "1"]) == 2
    assert "pip install 'fpcal-bayes[cluster]'" in capsys.readouterr().err
