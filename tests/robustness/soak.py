"""Simulated weeks end to end through the files, while every command is killed at random moments.

Each week: a full calibration, then a few sweeps a day, recorded as traces (`simulate --traces`), read (`ingest`),
followed (`track`), judged (`decide`) and driven (`control`). Each command is killed once or more before it may end. The
first week also runs in peace: every file must say the same. In all weeks no row may be missing.

    python tests/robustness/soak.py --weeks 8
"""

import argparse
import csv
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from fault_child import Child, meaning

from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join

CELL = load_cell(mechanics="none")
DAYS = 7
#: Sweeps of a daily session.
DAILY = 6
TOLERANCE_NM = 50.0


def week_plan(seed: int) -> Sweeps:
    """A calibration, and each day some of its sweeps."""
    random = np.random.default_rng([13, seed])
    paper = paper_protocol(CELL)
    parts = [replace(paper, session=np.full(len(paper), "full-day0"))]
    for day in range(1, DAYS + 1):
        chosen = paper.take(np.sort(random.choice(len(paper), DAILY, replace=False)))
        parts.append(replace(chosen, session=np.full(DAILY, f"day{day}"), time_h=np.full(DAILY, 24.0 * day)))
    return join(parts)


def commands(seed: int) -> list[tuple[str, list[str]]]:
    """Each command of a week, with the files it leaves."""
    return [
        (f"simulate --protocol plan.csv --traces --seed {seed} -o recorded.h5", ["recorded.h5"]),
        ("ingest recorded.h5 -o campaign.h5 --json ingested.json", ["campaign.h5", "ingested.json"]),
        (
            "track campaign.h5 --estimate estimate.json --json track.json",
            ["campaign.h5", "estimate.json", "track.json"],
        ),
        (f"decide campaign.h5 --tolerance-nm {TOLERANCE_NM:g} --json decision.json", ["decision.json"]),
        ("control --estimate estimate.json --task circle -o joints.csv", ["joints.csv"]),
    ]


def run_week(folder: Path, seed: int, kills: int, random: np.random.Generator) -> int:
    """Run a week; each command is killed up to `kills` times first. How many kills met a command under way."""
    write_csv(folder / "plan.csv", week_plan(seed), CELL)
    met, typical = 0, {"simulate": 3.0, "ingest": 6.0, "track": 3.0, "decide": 3.0, "control": 1.0}
    for line, outputs in commands(seed):
        words = tuple(line.split())
        for _ in range(kills):
            began = time.monotonic()
            outcome = Child(words, folder).wait(kill_after=float(random.uniform(0.0, 1.0) * typical[words[0]]))
            met += outcome.code is None
            if outcome.code is not None:
                # It ended first: the next kill comes sooner.
                typical[words[0]] = time.monotonic() - began
                require(outcome.code == 0, f"{line}: status {outcome.code}: {outcome.errors}")
        outcome = Child(words, folder).wait()
        require(outcome.code == 0, f"{line}: status {outcome.code}: {outcome.errors}")
        for name in outputs:
            require((folder / name).exists(), f"{line}: {name} is missing")
    return met


def check_week(folder: Path, seed: int) -> str:
    """Nothing is missing; a line about the week."""
    plan, campaign = week_plan(seed), read_campaign(folder / "campaign.h5", CELL)
    ingested = json.loads((folder / "ingested.json").read_text())
    doubtful = len(plan) - len(campaign.sweeps)
    said = json.dumps(ingested)
    require(doubtful >= 0, f"week {seed}: more rows than were planned")
    labels = set(zip(campaign.sweeps.session.tolist(), campaign.sweeps.label.tolist(), strict=True))
    for session, label in zip(plan.session.tolist(), plan.label.tolist(), strict=True):
        require((session, label) in labels or label in said, f"week {seed}: {session} {label} is lost")
    track = json.loads((folder / "track.json").read_text())
    require(len(track["sessions"]) == DAYS + 1, f"week {seed}: {len(track['sessions'])} sessions were followed")
    require(campaign.track is not None, f"week {seed}: the states are not saved")
    decision = json.loads((folder / "decision.json").read_text())["decision"]
    with (folder / "joints.csv").open(newline="") as file:
        driven = [row["status"] for row in csv.DictReader(file)]
    require(set(driven) == {"ok"}, f"week {seed}: the circle cannot be driven: {set(driven)}")
    verdicts = sorted({entry["verdict"] for entry in track["sessions"]})
    return f"{len(labels)} rows, {doubtful} doubtful, {'/'.join(verdicts)}, decision {decision['action']}"


def require(good: bool, message: str) -> None:
    if not good:
        raise RuntimeError(message)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weeks", type=int, default=8)
    parser.add_argument("--first", type=int, default=0, help="number of the first week")
    parser.add_argument("--kills", type=int, default=2, help="of each command of a week")
    options = parser.parse_args()
    random = np.random.default_rng(options.first)
    total, began = 0, time.monotonic()
    for seed in range(options.first, options.first + options.weeks):
        with tempfile.TemporaryDirectory() as name:
            killed = Path(name) / "killed"
            killed.mkdir()
            met = run_week(killed, seed, options.kills, random)
            line = check_week(killed, seed)
            total += met
            if seed == 0:
                peaceful = Path(name) / "peaceful"
                peaceful.mkdir()
                run_week(peaceful, seed, 0, random)
                for path in sorted(peaceful.iterdir()):
                    same = meaning(path) == meaning(killed / path.name)
                    require(same, f"{path.name}: another one after kills")
                line += f"; all {len(list(peaceful.iterdir()))} files as in peace"
            print(f"week {seed}: {met} kills met a command; {line}", flush=True)
    print(f"{options.weeks} weeks, {total} kills, nothing lost, {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
