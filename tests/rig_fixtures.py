"""An emulated cell and everything that drives it, for tests; every port is a free one."""

import multiprocessing
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.rig.agenda import Agenda, origin_of
from fpcal_bayes.rig.bench import Bench
from fpcal_bayes.rig.clock import Clock, Halt
from fpcal_bayes.rig.drivers.interface import CommandLog
from fpcal_bayes.rig.emulate.bench import EmulatedBench
from fpcal_bayes.rig.reader import read_rig
from fpcal_bayes.rig.route import Guard
from fpcal_bayes.rig.session import measure

RIG = """\
schema = "fpcal-rig/1"
name = "emulated"

[clock]
speedup = {speedup}

[session]
least_gap_um = 100
close_nm = 30
repeats = 1

[controller."E-712"]
driver = "pi-gcs2"
address = "127.0.0.1:0"
timeout_s = {timeout}
servo_on = true

[controller."MCS-3D"]
driver = "smaract-mcs2"
address = "127.0.0.1:0"
timeout_s = {timeout}

[interferometer]
driver = "attocube-ids"
address = "127.0.0.1:0"
timeout_s = {timeout}
noise_nm = 2.0
samples = 2
namespace = "{namespace}"

[joint]
q1 = {{ speed_um_s = 1500.0, tolerance_um = 0.005, settle_s = 0.05 }}
q2 = {{ speed_um_s = 300.0, tolerance_um = 0.005, settle_s = 0.05 }}
q3 = {{ speed_um_s = 1500.0, tolerance_um = 0.005, settle_s = 0.05 }}
q4 = {{ speed_deg_s = 20.0, tolerance_deg = 0.0001, settle_s = 0.05 }}
q5 = {{ speed_deg_s = 20.0, tolerance_deg = 0.0001, settle_s = 0.05 }}
q6 = {{ speed_deg_s = 100.0, tolerance_deg = 0.0001, settle_s = 0.05 }}
"""


#: A device is looked at so often while it moves, in s of a stepped clock.
POLL_S = 0.5


class SteppedClock(Clock):
    """A cell's clock that goes on when someone waits, and stands still else; processes may share it."""

    def __init__(self, moment: float) -> None:
        super().__init__()
        object.__setattr__(self, "shared", multiprocessing.Value("d", moment))

    def now(self) -> float:
        """Unix time of the cell."""
        return float(self.shared.value)

    def ticks(self) -> float:
        """As `now`."""
        return self.now()

    def wall(self, seconds: float) -> float:
        """Let time pass; the wall's stands still. The emulated devices wait for what is asked of them."""
        if threading.current_thread().name == "emulated cell":
            return 0.05
        self.shared.value += max(seconds, POLL_S)
        return 0.0

    def pass_until(self, moment: float) -> None:
        """Let time pass."""
        self.shared.value = max(moment, self.shared.value)


def write_rig(path: Path, *, speedup: float = 100.0, timeout: float = 0.5, namespace: str = "auto", extra="") -> Path:
    path.write_text(RIG.format(speedup=speedup, timeout=timeout, namespace=namespace) + extra)
    return path


@dataclass
class Live:
    """An emulated cell that runs, and the rig that finds it."""

    cell: object
    rig: object
    emulated: EmulatedBench
    folder: Path

    @property
    def lab(self):
        return self.emulated.lab

    def bench(self, halt: Halt, log: Path | None = None, guard: Guard | None = None) -> Bench:
        guard = Guard(self.cell, self.rig) if guard is None else guard
        return Bench(self.cell, self.rig, guard, halt, CommandLog(log, self.rig.clock), self.folder)

    def measure(self, ticket: Path, output: Path, *, halt: Halt | None = None, campaign=None, tell=lambda _: None):
        """As `fpcal measure` does; the agenda and the summary."""
        own = Halt() if halt is None else halt
        try:
            read = read_ticket(ticket, self.cell)
            origin = origin_of(read, campaign, self.rig.clock.now())
            agenda = Agenda(read, self.cell, self.rig, output, origin)
            guard = Guard(self.cell, self.rig)
            return agenda, measure(agenda, self.bench(own, guard=guard), guard, tell)
        finally:
            if halt is None:
                own.close()


@contextmanager
def live(cell, folder: Path, *, truth: Truth | None = None, machine=None, **settings):
    path = write_rig(folder / "rig.toml", **settings)
    emulated = EmulatedBench(read_rig(path, cell), cell, truth, machine)
    emulated.lab.length()
    emulated.server.start()
    try:
        emulated.write_live(folder / "live.toml")
        yield Live(cell, read_rig(folder / "live.toml", cell), emulated, folder)
    finally:
        emulated.server.stop()


def constant(cell) -> Truth:
    """A truth that does not drift."""
    truth = paper_truth(cell)
    return Truth(truth.parameters, truth.times_h[:1], truth.values[:1])


def write_ticket(path: Path, cell, rows=None, session: str = "s1") -> Path:
    """The paper's sweeps, or some of them, as a ticket."""
    plan = paper_protocol(cell, session=session)
    write_csv(path, plan if rows is None else plan.take(np.asarray(rows)), cell)
    return path
