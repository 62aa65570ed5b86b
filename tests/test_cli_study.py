import json

import pytest

from fpcal_bayes.cli.main import main


@pytest.mark.slow
def test_study_of_two_calibrations(tmp_path, capsys):
    """Through the command line, stopped after one replicate and taken up; then with nothing left to do."""
    store, out = tmp_path / "bands.jsonl", tmp_path / "bands.json"
    command = ["study", "coverage", "--workers", "1", "-o", str(store)]
    assert main([*command, "--replicates", "1", "--quiet"]) == 0
    assert main([*command, "--replicates", "2", "--json", str(out)]) == 0
    assert "1 were there before" in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert content["schema"] == "fpcal/1"
    assert content["command"] == "study"
    assert (content["study"], content["replicates"]) == ("coverage", 2)
    assert {row["n"] for row in content["rows"]} == {2}
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
        (["coverage", "--replicates", "3", "--workers", "0"], "--workers"),
        (["coverage", "--replicates", "3000000"], "at most 1000000"),
        (["coverage", "--replicates", "3", "--protocol", "missing.csv"], "missing.csv: no such file"),
        (["sbc", "--replicates", "3", "--draws", "100"], "--draws 100: expected more than 199"),
        (["coverage", "--replicates", "3", "-o", "no/where.jsonl"], "folder no does not exist"),
    ],
)
def test_wrong_usage_is_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["study", *arguments]) == 2
    text = capsys.readouterr().err
    assert message in text
    assert len(text.splitlines()) == 1
    assert not list(tmp_path.iterdir())
