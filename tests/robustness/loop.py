"""Two weeks of the loop with processes killed at random: nothing stale, measured twice, lost or half-written.

    python tests/robustness/loop.py [--hours 336] [--kills 100] [--seed 0]

A round of `fpcal keep` and a person who measures whenever the ticket has rows take turns, each in a process of its own,
which is killed now and then: at a random moment of the time that such a turn took before; a turn that ends earlier or
has nothing to do leaves its kill to the next. After each turn campaign, ticket and estimate are read.
"""

import argparse
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from fpcal_bayes.analysis.append import append
from fpcal_bayes.analysis.keep import Keeper, Outputs
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.sweeps import read_sweeps, write_sweeps
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
START = 1.8e9


def keep(folder: Path, now: float) -> None:
    """One round."""
    outputs = Outputs(folder / "now.json", folder / "ticket.csv", folder / "now.mat")
    costs = Costs(sigma_nm=5.0, most_sweeps=6, diagnosis_sweeps=6, diagnosis_h=24.0)
    Keeper(folder / "campaign.h5", CELL, Goal(50.0), lambda _: costs, outputs, lambda: now).round()


def measure(folder: Path, now: float) -> None:
    """What a careful script does: measure what the ticket asks for, hand it over."""
    ticket = read_ticket(folder / "ticket.csv", CELL)
    if ticket.plan is None or now > ticket.expires_utc:
        return
    name = str(ticket.plan.session[0])
    session = folder / f"{name}.csv"
    if not session.exists():
        rows = ticket.rows()
        rows = replace(rows, time_h=np.full(len(rows), (now - START) / 3600.0))
        number = int.from_bytes(name.encode(), "big") % 2**32
        write_sweeps(session, simulate_um(CELL, paper_truth(CELL), rows, sigma=0.005, seed=number), CELL)
        with (folder / "measured.log").open("a") as log:
            log.write(f"{name}\n")
    append(folder / "campaign.h5", session, CELL, ticket=folder / "ticket.csv")


def due(folder: Path, now: float) -> bool:
    """Whether the ticket asks for a measurement that is not in the campaign."""
    ticket = read_ticket(folder / "ticket.csv", CELL)
    if ticket.plan is None or now > ticket.expires_utc:
        return False
    return str(ticket.plan.session[0]) not in read_sweeps(folder / "campaign.h5", CELL).sessions


def turn(work: Callable[[Path, float], None], folder: Path, now: float, after_s: float | None) -> int:
    """Do some work in a process of its own, which is killed after so many seconds, if any; its exit status."""
    child = multiprocessing.get_context("fork").Process(target=work, args=(folder, now))
    child.start()
    if after_s is not None:
        time.sleep(after_s)
        if child.is_alive() and child.pid is not None:
            os.kill(child.pid, signal.SIGKILL)
    child.join()
    return child.exitcode or 0


def faults(folder: Path, sessions: list[str], n_rows: int, now: float) -> list[str]:
    """What is wrong with the files."""
    found = []
    try:
        sweeps = read_sweeps(folder / "campaign.h5", CELL)
        if list(sweeps.sessions[: len(sessions)]) != sessions or len(sweeps) < n_rows:
            found.append("a session is lost")
        if (folder / "now.json").exists():
            read_estimate(folder / "now.json", CELL)
            json.loads((folder / "now.json").read_text())
        if (folder / "ticket.csv").exists():
            ticket = read_ticket(folder / "ticket.csv", CELL)
            if ticket.plan is not None and ticket.expires_utc < now - 1800.0:
                found.append("a stale ticket stands")
    except InputError as error:
        found.append(str(error))
    log = folder / "measured.log"
    measured = log.read_text().split() if log.exists() else []
    if len(set(measured)) != len(measured):
        found.append("a session was measured twice")
    litter = [path.name for path in folder.iterdir() if path.name.startswith(".") and path.suffix == ".tmp"]
    return found + ([f"litter: {litter}"] if len(litter) > 2 else [])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hours", type=float, default=336.0)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random, step_h = np.random.default_rng(options.seed), 0.5
    n_turns = 2 * int(options.hours / step_h)
    killed = set(random.choice(n_turns, min(options.kills, n_turns), replace=False).tolist())
    wrong, dead, failed, pending = [], 0, 0, 0
    took = {keep: 1.0, measure: 1.0}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first = simulate_um(CELL, paper_truth(CELL), paper_protocol(CELL), sigma=0.005, seed=1)
        write_sweeps(folder / "campaign.h5", first, CELL)
        keep(folder, START)
        for number in range(n_turns):
            now = START + 3600.0 * step_h * (number // 2)
            work = (keep, measure)[number % 2]
            before = read_sweeps(folder / "campaign.h5", CELL)
            pending += number in killed
            busy = work is keep or due(folder, now)
            kill = pending > 0 and busy
            began = time.monotonic()
            status = turn(work, folder, now, float(random.uniform(0.0, took[work])) if kill else None)
            if not kill and busy:
                took[work] = time.monotonic() - began
            dead += status == -signal.SIGKILL
            pending -= status == -signal.SIGKILL
            failed += status not in (0, -signal.SIGKILL)
            if number % 2 or status:
                said = faults(folder, list(before.sessions), len(before), now)
                wrong += [f"turn {number}: {text}" for text in said]
        sessions = len(read_sweeps(folder / "campaign.h5", CELL).sessions)
    print(f"{n_turns} turns, {sessions} sessions, {dead} killed, {failed} ended with an error, {len(wrong)} faults")
    print("\n".join(wrong[:20]))
    return 1 if wrong or failed else 0


if __name__ == "__main__":
    sys.exit(main())
