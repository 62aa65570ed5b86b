"""Devices fail at random moments while a ticket is driven; whoever looks after the cell mends them; it goes on.

python tests/rig_faults.py [N] [SEED]   drives until N faults have happened, and prints what came of them.
"""

import re
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rig_fixtures import constant, live, write_ticket

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.rig.clock import Halted
from fpcal_bayes.rig.drivers.interface import DeviceError
from fpcal_bayes.rig.reader import FAULTS
from fpcal_bayes.rig.session import Failed
from fpcal_bayes.simulator.sweeps import noise_free

STAGES = ("E-712", "MCS-3D")
KINDS = {
    **dict.fromkeys(STAGES, tuple(kind for kind in FAULTS if kind != "lost-fringe")),
    "IDS3010": ("no-answer", "half-line", "reset", "lost-fringe"),
}
ONE_LINE = re.compile(r"(E-712|MCS-3D|IDS3010)(:| at 127\.0\.0\.1:\d+:) .*\S")
SWEEPS = (0, 1, 2, 45, 46, 47)


@dataclass
class Account:
    """What came of the faults."""

    faults: int = 0
    sessions: int = 0
    rows: int = 0
    doubtful: int = 0
    stopped: Counter = field(default_factory=Counter)
    worst_sd: float = 0.0
    chi_square: float = 0.0
    wrong: list[str] = field(default_factory=list)


def run(folder: Path, n_faults: int, seed: int, *, speedup: float = 1000.0, timeout: float = 0.15) -> Account:
    """Sessions one after the other, with a fault in each run, until so many faults have happened."""
    cell, random, account = load_cell(mechanics="none"), np.random.default_rng(seed), Account()
    # The emulated clock runs a thousand times faster than the light is asked to follow.
    assert cell.envelope is not None
    cell = replace(cell, envelope=replace(cell.envelope, max_fringe_rate=1e9))
    with live(cell, folder, truth=constant(cell), speedup=speedup, timeout=timeout) as found:
        while account.faults < n_faults:
            _session(found, random, account)
        lab = found.lab
        if not all(allowed for _, _, allowed in lab.commanded):
            account.wrong.append("a move outside the limits was commanded")
    return account


def _session(found, random, account: Account) -> None:
    """One ticket, run again until it is done."""
    account.sessions += 1
    name = f"s{account.sessions}"
    ticket = write_ticket(found.folder / f"{name}.csv", found.cell, SWEEPS, session=name)
    output, attempts = found.folder / f"{name}.h5", 0
    while True:
        attempts += 1
        device = str(random.choice(list(KINDS)))
        kind = str(random.choice(KINDS[device]))
        injected = threading.Event()
        timer = threading.Timer(
            float(random.uniform(0.0, 0.5)),
            _inject,
            (found, device, kind, float(10.0 ** random.uniform(0.0, 3.0)), injected),
        )
        timer.start()
        try:
            agenda, summary = found.measure(ticket, output)
        except Failed as failed:
            _judge(found, failed, account, f"{device} {kind}")
            agenda = None
        timer.cancel()
        timer.join()
        account.faults += injected.is_set()
        found.emulated.server.mend(device)
        if agenda is not None and not agenda.left:
            break
        if attempts > 60:
            account.wrong.append(f"{name}: not done after {attempts} runs")
            return
    account.doubtful += summary.doubtful
    if output.exists():
        _check_rows(found, output, account)


def _inject(found, device: str, kind: str, duration_s: float, injected: threading.Event) -> None:
    injected.set()
    found.emulated.server.inject(device, kind, duration_s)


def _judge(found, failed: Failed, account: Account, what: str) -> None:
    cause = failed.__cause__
    message = str(cause)
    account.stopped[what.split()[1]] += 1
    if isinstance(cause, Halted) or not ONE_LINE.fullmatch(message) or "\n" in message:
        account.wrong.append(f"{what}: {type(cause).__name__}: {message}")
    if not isinstance(cause, DeviceError) and "IDS3010: " not in message:
        account.wrong.append(f"{what}: {type(cause).__name__}: {message}")
    now = found.rig.clock.now()
    known = not failed.unsure
    if known and any(axis.moving(now) for axis in found.lab.axes):
        account.wrong.append(f"{what}: an axis moves after the end")


def _check_rows(found, output: Path, account: Account) -> None:
    sweeps = read_sweeps(output, found.cell)
    account.rows += len(sweeps)
    off = np.abs(sweeps.dl - noise_free(found.cell, found.lab.truth, sweeps)) / sweeps.sigma
    account.chi_square += float(np.sum(off**2))
    account.worst_sd = max(account.worst_sd, float(off.max()))
    account.wrong += [f"{output.name}: {sweeps.label[i]}: {off[i]:.1f} sd off" for i in np.flatnonzero(off > 6.0)]
    if len(set(sweeps.label.tolist())) != len(sweeps):
        account.wrong.append(f"{output.name}: a sweep stands twice")


if __name__ == "__main__":
    given = [int(text) for text in sys.argv[1:]]
    wanted, seed = (given + [500, 0][len(given) :])[:2]
    began = time.time()
    with tempfile.TemporaryDirectory() as folder:
        account = run(Path(folder), wanted, seed)
    print(f"{account.faults} faults in {account.sessions} sessions, {time.time() - began:.0f} s")
    print(f"stopped by: {dict(account.stopped)}")
    print(f"{account.rows} rows stored, {account.doubtful} sweeps marked doubtful")
    print(f"chi-square {account.chi_square:.1f} of {account.rows} rows, worst row {account.worst_sd:.2f} sd")
    for line in account.wrong:
        print("WRONG", line)
    sys.exit(bool(account.wrong))
