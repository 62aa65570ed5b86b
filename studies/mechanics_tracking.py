"""Simulated weeks of real machines: is the filter honest, and does it notice what was not modelled?

python studies/mechanics_tracking.py [--weeks 20] [--noise gaussian|student] [--change none|beta_4|knock|motions]

Each machine is drawn from the realistic sizes, with functions of another family than those that are fitted, its
geometry from the prior. It drifts as the cell's sizes say; a full calibration comes first, then sessions of few sweeps.
"""

import argparse
import time
from collections import Counter
from dataclasses import replace

import numpy as np
from mechanics_coverage import REALISTIC, reachable
from mechanics_coverage import protocol as calibration_plan
from tracking import change_of, diagnosis_plan, session_plan, told_in_time

from fpcal_bayes import InputError
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, drive_of_sweeps, join
from fpcal_bayes.model import Cell
from fpcal_bayes.simulator import Machine, MachineSettings
from fpcal_bayes.tracking import DriftModel, Track, track

HOURS = 168.0
SIGMA = 0.005
SETTINGS = MachineSettings(slow_nm=4.0, mirror_radius_m=50.0, scale_ppm=5.0)


def machine_cell() -> Cell:
    """The built-in cell with the realistic sizes."""
    return replace(load_cell(), mechanics=REALISTIC)


def simulate_week(cell: Cell, options: argparse.Namespace, seed: int) -> tuple[Sweeps, int | None]:
    """Sweeps of one week, and the number of the first session after the change."""
    rng = np.random.default_rng([options.seed, seed])
    settings = replace(SETTINGS, student=3.0 if options.noise == "student" else None)
    vector = reachable(cell, rng)
    machine = Machine.draw(cell, REALISTIC, vector, rng, settings)
    drift, slots = DriftModel.of(cell), cell.free.slots
    times = np.arange(0.0, HOURS + 1e-6, options.hours)
    steps = np.sqrt(np.diff(times, prepend=0.0) / 24.0)[:, None] * drift.walk * drift.scale
    values = vector[slots] + np.cumsum(steps * rng.standard_normal(steps.shape), axis=0)
    changed, other = None, machine
    if options.change != "none":
        changed = int(rng.integers(3, len(times) - 4))
        other = Machine.draw(cell, REALISTIC.scaled(5.0), vector, rng, settings)
    if options.change in ("beta_4", "knock"):
        values[changed:] += change_of(cell, options.change, rng)
    look = None
    if options.sweeps == "diagnosis":
        try:
            look = diagnosis_plan(cell.ideal, vector[slots], options.count, options.hours, int(rng.integers(2**31)))
        except InputError:
            # The mirror is out of sight at zero: another machine.
            return simulate_week(cell, options, seed + 100_000)
    parts = []
    for number, hour in enumerate(times):
        if number == 0:
            plan = calibration_plan(cell, options.protocol)
        else:
            plan = session_plan(options.count, "varied", rng) if look is None else look
        now = vector.copy()
        now[slots] = values[number]
        moved = options.change == "motions" and changed is not None and number >= changed
        true = replace(machine, vector=now, motions=other.motions if moved else machine.motions)
        measured = true.sweep(drive_of_sweeps(plan, REALISTIC.minutes_per_sweep), SIGMA)
        n = len(plan)
        named = replace(plan, session=np.full(n, f"{number:04d}"), time_h=np.full(n, hour))
        parts.append(named.with_measurement(measured, SIGMA))
    return join(parts), changed


def run(options: argparse.Namespace) -> None:
    """Simulate and follow the weeks, and print what was found."""
    cell = machine_cell()
    nis: list[np.ndarray] = []
    counts: Counter[str] = Counter()
    seconds, sessions = 0.0, 0
    for seed in range(options.first, options.first + options.weeks):
        sweeps, changed = simulate_week(cell, options, seed)
        began = time.process_time()
        found: Track = (told_in_time if options.pace else track)(cell, sweeps)
        seconds += time.process_time() - began
        sessions += len(found.outcomes)
        verdicts = [o.verdict for o in found.outcomes]
        quiet = found.outcomes[1 : changed if changed is not None else None]
        nis.append(np.array([(o.nis, o.dof) for o in quiet]))
        full = ("intrinsics-moved", "mechanics-moved")
        counts["weeks with a false full calibration"] += any(o.verdict in full for o in quiet)
        counts["false extrinsic alarms"] += sum(o.verdict == "extrinsics-moved" for o in quiet)
        counts["sweeps left out"] += sum("left out" in text for o in found.outcomes[1:] for text in o.warnings)
        if changed is not None:
            counts["full within 3 sessions"] += any(v in full for v in verdicts[changed : changed + 3])
            counts["mechanics-moved within 3 sessions"] += "mechanics-moved" in verdicts[changed : changed + 3]
            counts["any alarm within 3 sessions"] += any(v != "as-modelled" for v in verdicts[changed : changed + 3])
            counts["any alarm at the next session"] += verdicts[changed] != "as-modelled"
            counts["extrinsics-moved at the next session"] += verdicts[changed] == "extrinsics-moved"
        if options.verbose:
            share = [f"{o.nis / o.dof:.1f}{'' if o.verdict == 'as-modelled' else o.verdict[0]}" for o in quiet if o.dof]
            print(seed, " ".join(share), [o.evidence for o in quiet if o.verdict != "as-modelled"][:2])
    every = np.concatenate(nis)
    weeks = np.array([week[:, 0].sum() / max(week[:, 1].sum(), 1) for week in nis])
    print(
        f"NIS / dof {every[:, 0].sum() / every[:, 1].sum():.3f} (standard error over weeks "
        f"{weeks.std() / np.sqrt(len(weeks)):.3f}), median session {np.median(every[:, 0] / every[:, 1]):.3f}"
    )
    for name, count in counts.items():
        print(f"{name}: {count} of {len(nis)} weeks")
    print(f"{1e3 * seconds / sessions:.1f} ms CPU a session, the calibration included")


def parser() -> argparse.ArgumentParser:
    """The options of the study."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("--weeks", type=int, default=20)
    made.add_argument("--first", type=int, default=0, help="number of the first week")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--hours", type=float, default=8.0, help="between sessions")
    made.add_argument("--count", type=int, default=6, help="sweeps of a session")
    made.add_argument("--sweeps", choices=("varied", "diagnosis"), default="varied")
    made.add_argument("--noise", choices=("gaussian", "student"), default="gaussian")
    made.add_argument("--protocol", choices=("ends", "mid", "four"), default="mid", help="of the calibration")
    made.add_argument("--change", choices=("none", "beta_4", "knock", "motions"), default="none")
    made.add_argument("--pace", action="store_true", help="session by session, the pace of drift learnt")
    made.add_argument("--verbose", action="store_true")
    return made


if __name__ == "__main__":
    run(parser().parse_args())
