"""Simulated campaigns for the tests of tracking."""

from dataclasses import replace

import numpy as np

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.drift import DriftModel

CELL = load_cell(mechanics="none")
DRIFT = DriftModel.of(CELL)
PROTOCOL = paper_protocol(CELL)
SIGMA = 0.005


def plan(count: int, random: np.random.Generator) -> Sweeps:
    """The joints in turn, each over its range, at random poses."""
    high = np.array([150.0, 150.0, 150.0, *np.radians([3.0, 3.0, 90.0])])
    start = random.uniform(-high, high, (count, 6))
    end, rows, joint = start.copy(), np.arange(count), np.arange(count) % 6
    start[rows, joint], end[rows, joint] = -high[joint], high[joint]
    return Sweeps.of_um_rad(start, end, label=[f"q{j + 1}-{i}" for i, j in enumerate(joint)])


def campaign(
    seed: int,
    *,
    sessions: int = 6,
    hours: float = 8.0,
    count: int = 6,
    change: np.ndarray | None = None,
    changed: int = 0,
) -> tuple[Truth, Sweeps]:
    """A calibration, then sessions of `count` sweeps while the cell drifts; `change` is added from a session on."""
    random = np.random.default_rng(seed)
    times = hours * np.arange(sessions + 1)
    steps = random.standard_normal((sessions + 1, len(CELL.free))) * DRIFT.walk * DRIFT.scale * np.sqrt(hours / 24.0)
    steps[0] = 0.0
    values = paper_truth(CELL).at(0.0) + np.cumsum(steps, axis=0)
    if change is not None:
        values[changed:] += change
    parts = [replace(PROTOCOL, session=np.full(69, "day0"))]
    for i, time in enumerate(times[1:], 1):
        parts.append(replace(plan(count, random), session=np.full(count, f"s{i}"), time_h=np.full(count, time)))
    truth = Truth(CELL.free, times, values)
    return truth, simulate_um(CELL, truth, join(parts, file="campaign"), sigma=SIGMA, seed=seed)


def knock(random: np.random.Generator) -> np.ndarray:
    """A jump of every extrinsic parameter by 0.1 deg or 20 um, in um and rad."""
    size = np.array([np.radians(0.1) if p.unit == "deg" else 20.0 for p in CELL.free])
    return np.where([p.kind == "extrinsic" for p in CELL.free], size * random.choice([-1.0, 1.0], len(CELL.free)), 0.0)


def step_of_beta_4() -> np.ndarray:
    """A step of beta_4 by 0.1 deg."""
    return np.where([p.name == "beta_4" for p in CELL.free], np.radians(0.1), 0.0)
