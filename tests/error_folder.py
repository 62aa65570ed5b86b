"""A folder of good and damaged files, on which the table of errors in the documentation stands."""

import json
from pathlib import Path

import numpy as np

from fpcal_bayes.core.resources import data_file
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.io.campaign import write_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um


def fill(folder: Path) -> None:
    """Write all files: good ones, and from each a few with one fault."""
    cell = load_cell(mechanics="none")
    sweeps = simulate_um(cell, paper_truth(cell), paper_protocol(cell), sigma=0.005, seed=0)
    write_csv(folder / "sweeps.csv", sweeps, cell)
    write_csv(folder / "plan.csv", paper_protocol(cell), cell)
    write_campaign(folder / "campaign.h5", Campaign.of(sweeps, cell), cell)
    found = identify(cell, sweeps)
    estimate = {"schema": "fpcal/1", "command": "identify", **found.content()}
    _json(folder / "day0.json", estimate)
    (folder / "femto-st.toml").write_bytes(data_file("femto-st.toml").read_bytes())
    (folder / "path.csv").write_text("x_um,y_um,z_um,rx_deg,ry_deg,rz_deg\n0,0,0,0,0,0\n1,0,0,0,0,0\n")
    _damaged_sweeps(folder, (folder / "sweeps.csv").read_text())
    _json(folder / "other-schema.json", estimate | {"schema": "other/1"})
    _json(folder / "other-cell.json", estimate | {"cell": estimate["cell"] | {"sha256": "0" * 64, "name": "other"}})
    _json(folder / "unconverged.json", estimate | {"fit": estimate["fit"] | {"converged": False}})
    (folder / "cut.json").write_text((folder / "day0.json").read_text()[:200])
    (folder / "cut.h5").write_bytes((folder / "campaign.h5").read_bytes()[:3000])
    text = (folder / "femto-st.toml").read_text()
    (folder / "key.toml").write_text(text.replace("wavelength_nm", "wave_nm", 1))
    (folder / "broken.toml").write_text(text.replace("[optics]", "[optics", 1))
    (folder / "path-nan.csv").write_text("x_um,y_um,z_um,rx_deg,ry_deg,rz_deg\n0,0,0,0,0,nan\n")
    late = np.arange(69) >= 60
    overlapping = sweeps.take(np.ones(69, dtype=bool))
    overlapping.session[late] = "second"
    overlapping.time_h[:] = np.where(late, 0.0, np.linspace(0.0, 2.0, 69))
    write_csv(folder / "overlap.csv", overlapping, cell)
    write_csv(folder / "few.csv", sweeps.take(np.arange(3)), cell)


def _damaged_sweeps(folder: Path, text: str) -> None:
    lines = text.splitlines(keepends=True)

    def put(name: str, row: int, column: str, value: str) -> None:
        fields = lines[row - 1].rstrip("\n").split(",")
        fields[lines[0].rstrip("\n").split(",").index(column)] = value
        (folder / name).write_text("".join([*lines[: row - 1], ",".join(fields) + "\n", *lines[row:]]))

    (folder / "empty.csv").write_text("")
    (folder / "header.csv").write_text(lines[0])
    (folder / "semicolons.csv").write_text(text.replace(",", ";"))
    (folder / "misnamed.csv").write_text(text.replace("dl_um", "dL", 1))
    (folder / "beam.csv").write_text(text.replace(",signed\n", ",signed,beam\n", 1).replace(",1\n", ",1,left\n"))
    (folder / "binary.csv").write_bytes(b"session,\xff\xfe\n")
    (folder / "short.csv").write_text("".join([*lines[:4], "full-T0,0\n", *lines[4:]]))
    put("word.csv", 5, "dl_um", "x")
    put("nothing.csv", 6, "sigma_um", "")
    put("sigma.csv", 7, "sigma_um", "-0.005")
    put("sign.csv", 8, "signed", "2")
    put("limit.csv", 9, "q4_end_deg", "9")
    put("label.csv", 10, "label", "x" * 1001)


def _json(path: Path, content: dict[str, object]) -> None:
    path.write_text(json.dumps(content))
