"""Weeks of a cell that keeps itself calibrated: does the circle stay within its tolerance as often as is promised?

    python tests/robustness/rig_weeks.py [--weeks 2] [--days 7] [--first 0] [--tolerance-nm 50] [--mechanics stated]

Each week has a geometry drawn from the prior, which drifts as the cell says, and with mechanics a machine of its own
behind emulated controllers and an emulated interferometer. Day 0 is measured by `fpcal measure`; from then on
`fpcal keep --rig` looks every quarter of an hour in which it has something to do, and measures its tickets; it is ended
and started anew each day. A controller, a process of its own, reads the estimate that stands in the file and drives the
circle over the wire. The circle's true error at its stops is what counts; the promise is the forecast of the same
moment.

The clock of the cell stands still while a program works and goes on while it waits, so that no number depends on how
busy the computer is.
"""

import argparse
import contextlib
import io
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from rig_fixtures import SteppedClock, write_rig, write_ticket  # noqa: E402

from fpcal_bayes.analysis.keep import Round  # noqa: E402
from fpcal_bayes.cli import keep  # noqa: E402
from fpcal_bayes.cli.main import main as fpcal  # noqa: E402
from fpcal_bayes.core.errors import InputError  # noqa: E402
from fpcal_bayes.decision.forecast import Goal  # noqa: E402
from fpcal_bayes.decision.policy import last_forecast  # noqa: E402
from fpcal_bayes.infer.tasks.error import task_rows  # noqa: E402
from fpcal_bayes.infer.tasks.source import PATH_POINTS  # noqa: E402
from fpcal_bayes.io.cell import load_cell  # noqa: E402
from fpcal_bayes.io.estimate import read_estimate  # noqa: E402
from fpcal_bayes.measure.truth import Truth  # noqa: E402
from fpcal_bayes.model.cavity import CavityModel  # noqa: E402
from fpcal_bayes.model.cell.cell import Cell  # noqa: E402
from fpcal_bayes.motion import compensated, task_path  # noqa: E402
from fpcal_bayes.rig import reader  # noqa: E402
from fpcal_bayes.rig.bench import Bench  # noqa: E402
from fpcal_bayes.rig.clock import Halt  # noqa: E402
from fpcal_bayes.rig.drivers.interface import CommandLog  # noqa: E402
from fpcal_bayes.rig.emulate.bench import EmulatedBench  # noqa: E402
from fpcal_bayes.rig.route import Guard  # noqa: E402
from fpcal_bayes.simulator.sweeps import machine_of  # noqa: E402
from fpcal_bayes.tracking import DriftModel  # noqa: E402

#: Hours between two epochs of the truth: drift is smooth while a session lasts, a few minutes.
EPOCH_H = 1.0
#: Hours between two looks of `fpcal keep`, and between two circles on the average.
LOOK_H, CIRCLE_H = 0.25, 2.0
#: A truth is drawn for so long at least, so that a shorter run is the beginning of a longer one.
HOURS = 168.0
#: Looks in which nothing can have changed are left out, but never for longer than this.
MOST_H = 4.0
START, DAY_S = 1.8e9, 86400.0


def controller(cell: Cell, folder: Path, orders: Connection) -> None:
    """Drive the circle by the estimate that stands in the file whenever asked to; each stop is told and judged."""
    rig = reader.read_rig(folder / "live.toml", cell)
    halt, log = Halt(), CommandLog(None, rig.clock)
    while orders.recv():
        estimate = read_estimate(folder / "now.json", cell)
        task = compensated(estimate, task_path(cell, estimate.vector(), "circle", n_points=PATH_POINTS).driven())
        model = CavityModel.of(cell, estimate.parameters)
        wanted = model.predict(estimate.values, task_rows(model, task)) - (0.0 if task.added is None else task.added)
        guard = Guard(cell, rig, estimate)
        bench = Bench(cell, rig, guard, halt, log, folder)
        bench.prepare()
        bench.go(task.start, "to the circle")
        stops = [task.start, *task.q]
        guard.check_moves([(a, b, "the circle") for a, b in pairwise(stops)])
        for q, length in zip(task.q, wanted, strict=True):
            bench.go(q, "the circle")
            orders.send(float(length))
            orders.recv()
        orders.send(None)
        bench.close()


class Week:
    """One cell for a week."""

    def __init__(self, cell: Cell, folder: Path, options: argparse.Namespace, seed: int) -> None:
        self.cell, self.folder, self.options = cell, folder, options
        self.rng = np.random.default_rng([seed, 77])
        self.clock: SteppedClock = reader.Clock()
        self.goal = Goal(options.tolerance_nm)
        self.words = ["--mechanics", options.mechanics, "--quiet"]
        drift = DriftModel.of(cell)
        times = np.arange(0.0, max(24.0 * options.days, HOURS) + 12.0, EPOCH_H)
        steps = self.rng.standard_normal((len(times), len(cell.free))) * drift.walk * drift.scale
        steps[0] = 0.0
        values = self.geometry() + np.cumsum(np.sqrt(EPOCH_H / 24.0) * steps, axis=0)
        rig = write_rig(folder / "rig.toml", timeout=60.0)
        self.emulated = EmulatedBench(reader.read_rig(rig, cell), cell, Truth(cell.free, times, values))
        if cell.mechanics is not None:
            self.emulated.lab.machine = machine_of(cell, self.emulated.lab.truth, seed)
        self.emulated.write_live(folder / "live.toml")
        self.inside: list[bool] = []
        self.promised: list[float] = []
        self.found: list[Round] = []
        self.actions: Counter[str] = Counter()
        self.rounds = self.sessions = 0
        self.began = self.next_circle = 0.0
        # What the command tells a person is told the judge.
        keep._Teller.tell = lambda _, found: self.tell(found)

    def tell(self, found: Round) -> None:
        """Take note of a round."""
        self.found = [found]
        self.actions["none" if found.decision is None else found.decision.action] += 1

    def geometry(self) -> np.ndarray:
        """Drawn from the prior such that the circle can be driven; the gap is as the cell's envelope states it."""
        cell, envelope = self.cell, self.cell.envelope
        at = cell.free.names.index("y_wf")
        model = CavityModel.of(cell)
        while True:
            values = cell.free.nominal + cell.free.prior_sd * self.rng.standard_normal(len(cell.free))
            gap = envelope.gap + envelope.gap_sd * self.rng.standard_normal()
            values[at] += gap - float(model.predict(values, model.pose_rows(np.zeros((1, 6))))[0])
            with contextlib.suppress(InputError):
                if task_path(cell, model.vector(values), "circle", n_points=9).ok.all():
                    return values

    def run(self, circle: Connection) -> None:
        """Day 0, then rounds and circles until the week is over."""
        campaign, live = self.folder / "campaign.h5", str(self.folder / "live.toml")
        self.began = self.next_circle = self.clock.now()
        plan = self.folder / "day0.csv"
        write_ticket(plan, self.cell, session="full-0")
        head, *rows = plan.read_text().splitlines()
        plan.write_text("\n".join([f"{head},readings", *(f"{row},2" for row in rows)]) + "\n")
        self.command("measure", str(plan), "--rig", live, "-o", str(campaign))
        line = ["keep", str(campaign), "--ticket", str(self.folder / "ticket.csv"), "--rig", live]
        line += ["--estimate", str(self.folder / "now.json"), "--tolerance-nm", str(self.options.tolerance_nm)]
        end = self.began + DAY_S * self.options.days

        def day(_file: object, _look_s: float, take_in: Callable[[bool], None], *_: object, **__: object) -> None:
            """In the place of `watch`: rounds as the cell's clock says."""
            over = min(end, self.clock.now() + DAY_S)
            while self.clock.now() < over:
                take_in(False)
                self.after_round(circle)
            raise SystemExit

        keep.watch = day
        while self.clock.now() < end:
            self.command(*line)

    def after_round(self, circle: Connection) -> None:
        """Let the controller drive circles until the next round."""
        self.rounds += 1
        found, clock = self.found[-1], self.clock
        track, last = found.followed.track, found.followed.track.last
        self.sessions = len(track.outcomes)
        if found.ticket.plan is not None:
            # What has just been measured is published in the next round, which follows at once.
            return
        decision = found.decision
        held_h = 0.0 if decision is None else decision.now_h + decision.hold_hours - found.now_h
        until = clock.now() + 3600.0 * LOOK_H * max(1.0, min(held_h, MOST_H) // LOOK_H)
        forecast = None
        if found.valid_until_h is not None:
            forecast = last_forecast(track, self.goal)
        while self.next_circle < until:
            clock.pass_until(self.next_circle)
            if forecast is not None:
                hours = (clock.now() - self.began) / 3600.0 - last.time_h
                self.promised.append(1.0 - forecast.exceeds(last.state, hours))
                self.inside.append(self.error_nm(circle) <= self.goal.tolerance_nm)
            self.next_circle += 3600.0 * CIRCLE_H * float(self.rng.uniform(0.5, 1.5))
        clock.pass_until(until)

    def error_nm(self, circle: Connection) -> float:
        """Have the circle driven; its true error, peak to peak."""
        off: list[float] = []
        circle.send(True)
        while (wanted := circle.recv()) is not None:
            off.append(self.emulated.lab.length() - wanted)
            circle.send(True)
        return 1e3 * float(np.ptp(off))

    def command(self, *words: str) -> None:
        """Run `fpcal`; what it says is shown where it fails."""
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            status = fpcal([*words, *self.words])
        if status:
            raise RuntimeError(f"fpcal {' '.join(words)}: status {status}\n{said.getvalue()}")


def one_week(cell: Cell, options: argparse.Namespace, seed: int, clock: SteppedClock) -> Week:
    """Serve, measure, keep and drive."""
    clock.shared.value = START
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as name:
        week = Week(cell, Path(name), options, seed)
        ours, theirs = context.Pipe()
        child = context.Process(target=controller, args=(cell, Path(name), theirs), daemon=True)
        child.start()
        theirs.close()
        week.emulated.server.start()
        try:
            week.run(ours)
            ours.send(False)
        finally:
            child.join(10.0)
            child.terminate()
            week.emulated.server.stop()
        if not all(allowed for _, _, allowed in week.emulated.lab.commanded):
            raise RuntimeError(f"week {seed}: a move outside the limits was commanded")
        return week


def main() -> int:
    """Print a line per week, and at last whether the share is as promised."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weeks", type=int, default=2)
    parser.add_argument("--first", type=int, default=0, help="seed of the first week")
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--tolerance-nm", type=float, default=50.0)
    parser.add_argument("--mechanics", choices=["none", "stated"], default="none")
    options = parser.parse_args()
    cell = load_cell(mechanics=options.mechanics)
    clock = SteppedClock(START)
    reader.Clock = lambda *_: clock
    shares = []
    for seed in range(options.first, options.first + options.weeks):
        began = os.times()
        week = one_week(cell, options, seed, clock)
        used = sum(os.times()[:4]) - sum(began[:4])
        n = len(week.inside)
        if n:
            shares.append((float(np.mean(week.inside)), float(np.mean(week.promised))))
        print(
            f"week {seed}: {week.sessions} sessions, rounds {dict(week.actions)}, {n} circles, "
            + (f"within {100 * shares[-1][0]:.1f} %, promised {100 * shares[-1][1]:.1f} %, " if n else "no promise, ")
            + f"{used:.0f} s CPU, {time.strftime('%H:%M')}",
            flush=True,
        )
    kept = np.array(shares).reshape(-1, 2)
    if len(kept) < 2:
        print(f"{len(kept)} weeks with a promise")
        return 0
    away = kept[:, 0] - kept[:, 1]
    error = float(away.std(ddof=1) / np.sqrt(len(away)))
    print(
        f"{len(kept)} of {options.weeks} weeks with a promise: within {100 * kept[:, 0].mean():.1f} %, promised "
        f"{100 * kept[:, 1].mean():.1f} %, difference {100 * away.mean():+.2f}, standard error {100 * error:.2f}"
    )
    return int(abs(away.mean()) > 3.0 * error)


if __name__ == "__main__":
    sys.exit(main())
