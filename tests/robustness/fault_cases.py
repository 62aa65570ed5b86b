"""The commands into which faults are injected, and one valid file of every kind that they read."""

import contextlib
import csv
import io
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from fpcal_bayes.cli.main import main as fpcal
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.study.coverage import Coverage
from fpcal_bayes.study.run import run_study


@dataclass(frozen=True)
class Case:
    """One command: its arguments, with the files it reads and those it writes."""

    name: str
    arguments: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...] = ()

    @classmethod
    def of(cls, line: str, inputs: str, outputs: str = "") -> "Case":
        words = tuple(line.split())
        return cls(words[0], words, tuple(inputs.split()), tuple(outputs.split()))


#: Modified DH parameters of a robot.
AXES = "prismatic,0,10,5,20\nprismatic,-90,0,90,0\nrevolute,-80,100,40,-20\nrevolute,70,0,-15,50\n"
COVERAGE = "study coverage --replicates 4 --workers 1 --protocol sweeps.csv"
#: Quick commands, then slower ones that only the whole study runs.
QUICK = (
    Case.of("identify sweeps.csv --json out.json", "sweeps.csv", "out.json"),
    Case.of("identify campaign.h5 --json out.json", "campaign.h5", "out.json"),
    Case.of("identify sweeps.csv --cell cell.toml --json out.json", "cell.toml", "out.json"),
    Case.of("identify sweeps.csv --start estimate.json --json out.json", "estimate.json sweeps.csv", "out.json"),
    Case.of("identify sweeps.csv --prior estimate.json --json out.json", "estimate.json sweeps.csv", "out.json"),
    Case.of("simulate --truth truth.toml -o out.csv", "truth.toml", "out.csv"),
    Case.of("simulate --protocol sweeps.csv -o out.h5", "sweeps.csv", "out.h5"),
    Case.of("control --estimate estimate.json --task path.csv -o out.csv", "estimate.json path.csv", "out.csv"),
    Case.of("control --estimate estimate.json --task circle -o out.mat", "estimate.json", "out.mat"),
    Case.of("task-error estimate.json --task circle --json out.json", "estimate.json", "out.json"),
    Case.of("track campaign.h5 --estimate out.json", "campaign.h5", "out.json"),
    Case.of("cell cell.toml --figure out.svg --json out.json", "cell.toml", "out.svg out.json"),
    Case.of("cell --from-dh axes.csv -o out.toml", "axes.csv", "out.toml"),
    Case.of("append campaign.h5 session.csv --json out.json", "campaign.h5 session.csv", "out.json"),
    Case.of("export asked.csv -o out.csv", "asked.csv", "out.csv"),
    Case.of("export asked.csv -o out.mat", "asked.csv", "out.mat"),
    Case.of("import moves.csv -o out.h5", "moves.csv", "out.h5"),
)
SLOW = (
    Case.of("observe sweeps.csv --json out.json --html out.html", "sweeps.csv", "out.json out.html"),
    Case.of("compare sweeps.csv --models opd=axis,opd=perpendicular --json out.json", "sweeps.csv", "out.json"),
    Case.of(
        "plan --n 2 --draws 2 --candidates 40 --after sweeps.csv -o out.csv --rows rows.h5 "
        "--figure out.svg --json out.json",
        "sweeps.csv",
        "out.csv rows.h5 out.svg out.json",
    ),
    Case.of("sample sweeps.csv -o out.nc --draws 50 --json out.json", "sweeps.csv", "out.nc out.json"),
    Case.of("track sessions.csv --json out.json --flat flat.mat", "sessions.csv", "out.json flat.mat"),
    Case.of("decide campaign.h5 -o out.csv --json out.json", "campaign.h5", "out.json"),
    Case.of("task-error posterior.nc --task circle --json out.json", "posterior.nc", "out.json"),
    Case.of("doctor campaign.h5 --json out.json", "campaign.h5", "out.json"),
    Case.of("report campaign.h5 -o out.html --json out.json", "campaign.h5", "out.html out.json"),
    Case.of("simulate --protocol plan.csv --traces -o out.h5", "plan.csv", "out.h5"),
    Case.of("ingest index.h5 -o out.csv", "index.h5", "out.csv"),
    Case.of("ingest index.csv -o out.h5", "index.csv index_traces", "out.h5"),
    Case.of("ingest index.mat -o out.csv", "index.mat", "out.csv"),
    Case.of("check driven.csv --estimate estimate.json --json out.json", "driven.csv estimate.json", "out.json"),
    Case.of("week --no-page --cell cell.toml -o out", "cell.toml", "out/campaign.h5 out/posterior.nc out/report.txt"),
    Case.of(f"{COVERAGE} -o out.jsonl", "sweeps.csv", "out.jsonl"),
    # Half of the replicates are there.
    Case.of(f"{COVERAGE} -o store.jsonl", "store.jsonl sweeps.csv", "store.jsonl"),
)


def make_inputs(folder: Path, *, quick: bool) -> None:
    """One valid file of every kind that a command reads."""
    lines = ["simulate -o sweeps.csv --protocol paper-mid", "identify sweeps.csv --json estimate.json"]
    with contextlib.chdir(folder):
        shutil.copy(data_file("femto-st.toml"), "cell.toml")
        Path("truth.toml").write_text("[parameters]\nalpha_2 = -90.1\nz_et = 12.0\n")
        Path("path.csv").write_text(
            "x_um,y_um,z_um,rx_deg,ry_deg,rz_deg\n0,0,0,0,0,0\n20,0,10,0.5,0,0\n40,0,20,1,0,0\n"
        )
        for line in lines:
            in_process(line.split())
        Path("axes.csv").write_text("kind,alpha_deg,a_um,theta_deg,d_um\n" + AXES)
        rows = Path("sweeps.csv").read_text().splitlines()
        first = [row.replace("full-T0", "a-day0") for row in rows[1:]]
        days = ["a-day0,0.0", "b-day1,24.0", "c-day2,48.0"]
        later = [
            ",".join([session, *row.split(",")[2:]])
            for session in days[1:]
            for row in rows[1:]
            if "-tz" in row.split(",")[2]
        ]
        Path("sessions.csv").write_text("\n".join([rows[0], *first, *later]) + "\n")
        in_process(["simulate", "--protocol", "sessions.csv", "-o", "campaign.h5"])
        new = [rows[0], *(row.replace("full-T0,0", "d-day3,72") for row in rows[1:9])]
        Path("session.csv").write_text("\n".join(new) + "\n")
        # Without what is measured: session, hour, label, six joints at both ends.
        asked = [",".join(row.split(",")[:15]) for row in new]
        Path("asked.csv").write_text("\n".join(asked) + "\n")
        in_process(["export", "asked.csv", "-o", "moves.csv"])
        if not quick:
            in_process(["simulate", "-o", "ends.csv"])
            ends = Path("ends.csv").read_text().splitlines()
            Path("plan.csv").write_text("\n".join([ends[0], *ends[1:3], *ends[-3:]]) + "\n")
            for line in (
                "sample sweeps.csv -o posterior.nc --draws 50",
                "simulate --protocol plan.csv --traces -o index.h5",
                "simulate --protocol plan.csv --traces -o index.csv",
                "control --estimate estimate.json --task circle -o joints.csv",
                "simulate --path joints.csv --traces -o driven.csv",
            ):
                in_process(line.split())
            make_matlab_index(Path("index.csv"), Path("index.mat"))
            make_store(Path("store.jsonl"), 2)


def make_matlab_index(index: Path, output: Path) -> None:
    """The traces of an index as variables of a MATLAB file."""
    with index.open(newline="") as file:
        rows = list(csv.DictReader(file))
    content: dict[str, Any] = {
        name: np.array([[float(row[name])] for row in rows]) for name in rows[0] if name.endswith(("_um", "_deg"))
    }
    traces = [np.loadtxt(index.parent / row["trace"], delimiter=",", skiprows=1) for row in rows]
    for column, name in enumerate(("t_s", "joint", "irradiance_v")):
        cells = np.empty((len(rows), 1), dtype=object)
        cells[:, 0] = [trace[:, column] for trace in traces]
        content[name] = cells
    savemat(output, content)


def make_store(path: Path, replicates: int) -> None:
    """The first replicates of the study of coverage."""
    cell = load_cell(mechanics="none")
    plan = read_sweeps("sweeps.csv", cell, plan=True)
    run_study(Coverage(cell=cell, plan=plan), path, replicates, workers=0)


def in_process(arguments: list[str]) -> None:
    """Run a command that must succeed."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        code = fpcal(arguments)
    if code != 0:
        raise RuntimeError(f"{' '.join(arguments)}: exit status {code}: {text.getvalue()}")
