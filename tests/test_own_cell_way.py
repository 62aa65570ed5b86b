"""A cell made from words goes the whole way, from a plan to a report, by commands alone."""

import json
from pathlib import Path

import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.io.tickets import read_ticket


def ran(line: str, cell: str, *, status: int = 0) -> None:
    assert main([*line.split(), *cell.split(), "--mechanics", "none", "--quiet"]) == status, line


@pytest.mark.slow
@pytest.mark.parametrize(("words", "radius"), [("-z rx x -ry y rz", 30), ("x y z rx rz", 30)])
def test_the_whole_way(tmp_path, monkeypatch, words, radius):
    monkeypatch.chdir(tmp_path)
    assert main(["cell", "--new", words, "--name", "lab", "-o", "lab.toml", "--gap-um", "600", "--gap-sd-um", "1"]) == 0
    text = Path("lab.toml").read_text()
    # Known as well as after a careful assembly, and with the light that such a gap gives back.
    Path("lab.toml").write_text(text.replace("prior_sd_deg = 1 ", "prior_sd_deg = 0.3 "))
    cell = "--cell lab.toml"
    ran(f"plan --n 14 --draws 8 --candidates 200 --radius-um {radius} -o plan.csv", cell)
    ran("simulate --protocol plan.csv --traces --seed 3 -o rec.csv", cell)
    ran("ingest rec.csv -o day0.h5 --points 1 --no-plots", cell)
    ran("identify day0.h5 --json day0.json", cell)
    assert json.loads(Path("day0.json").read_text())["trust"]["usable"]
    ran(f"task-error day0.json --task circle --radius-um {radius} --tolerance-nm 50 --json task.json", cell)
    ran(f"control --estimate day0.json --task circle --radius-um {radius} -o joints.csv", cell)
    low, high = (
        json.loads(Path("task.json").read_text())["tasks"]["circle"]["peak_to_peak_nm"][k] for k in ("low", "high")
    )
    assert 0 < low < high < 1000
    made = load_cell("lab.toml", mechanics="none")
    for number in range(1, 3 if len(words.split()) == 6 else 2):
        hours = 30.0 * number
        ran(f"decide day0.h5 --radius-um {radius} --now {hours} --tolerance-nm 20 -o ticket.csv", cell)
        ticket = read_ticket("ticket.csv", made)
        assert ticket.plan is not None, "a day of drift is more than 20 nm"
        ran(f"simulate --protocol ticket.csv --truth rec_truth.toml --seed {number} -o session.csv", cell)
        ran("append day0.h5 session.csv --ticket ticket.csv", cell)
        ran("track day0.h5 --estimate now.json --flat now.mat", cell)
    assert len(read_sweeps("day0.h5", made).sessions) == 1 + number
    ran(f"report day0.h5 -o report.html --radius-um {radius} --tolerance-nm 20", cell)
    assert "lab" in Path("report.html").read_text()
