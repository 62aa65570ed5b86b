"""Inputs of any size for the measurements of time and memory against size."""

from dataclasses import replace

import numpy as np

from fpcal_bayes.measure import Sweeps, Truth, join, paper_protocol, paper_truth
from fpcal_bayes.model import EXTRINSICS, LINK_SLOTS, UNITS, Cell, Joint, make_parameters
from fpcal_bayes.simulator import simulate_um

SIGMA = 0.005


def random_poses(cell: Cell, n: int, seed: int = 0) -> np.ndarray:
    """Joint vectors within the paper's ranges, shape (n, n_joints)."""
    reach = np.where(cell.revolute, np.radians(5.0), 150.0)
    return np.random.default_rng(seed).uniform(-reach, reach, (n, len(cell.joints)))


def random_sweeps(cell: Cell, n: int, seed: int = 0) -> Sweeps:
    """Sweeps of one joint each from anywhere to anywhere within the paper's ranges."""
    start = random_poses(cell, n, seed)
    random = np.random.default_rng([seed, 1])
    reach = np.where(cell.revolute, np.radians(5.0), 150.0)
    joint = random.integers(len(cell.joints), size=n)
    end = start.copy()
    end[np.arange(n), joint] = random.uniform(-reach[joint], reach[joint])
    return Sweeps.of_um_rad(start, end)


def measured(cell: Cell, n: int) -> Sweeps:
    """Random sweeps measured at the paper's truth."""
    return simulate_um(cell, paper_truth(cell), random_sweeps(cell, n), sigma=SIGMA, seed=1)


def sessions(cell: Cell, count: int, rows: int) -> Sweeps:
    """A full calibration, and sessions of some rows every hour."""
    parts = [paper_protocol(cell, session="full")]
    for number in range(1, count):
        plan = random_sweeps(cell, rows, seed=number)
        parts.append(replace(plan, session=np.full(rows, f"s{number:05d}"), time_h=np.full(rows, float(number))))
    return simulate_um(cell, paper_truth(cell), join(parts), sigma=SIGMA, seed=2)


def wide_cell(n_free: int) -> Cell:
    """A chain of eight joints with so many free parameters."""
    entries = {}
    for name in [*EXTRINSICS, *(f"{stem}_{i}" for i in range(1, 9) for stem in LINK_SLOTS)][:n_free]:
        stem = name if name in EXTRINSICS else name.rpartition("_")[0]
        entries[name] = (0.0, np.radians(0.1) if UNITS[stem] == "deg" else 1e-3 if stem == "gain" else 5.0, False)
    # The mirror faces the fibre, nearly a millimetre away.
    for name, nominal in (("y_wf", 920.0), ("beta_et", np.radians(-90.0))):
        entries[name] = (nominal, entries.get(name, (0.0, 0.0))[1], False)
    joints = tuple(Joint("revolute", -np.inf, np.inf, 0.0, None) for _ in range(8))
    return Cell(f"wide-{n_free}", joints, make_parameters(entries, 8), 1.56, "axis", "minus-y")


def drawn_near(cell: Cell) -> Truth:
    """A truth a tenth of a prior standard deviation from nominal."""
    n = len(cell.free)
    values = cell.free.nominal + 0.1 * cell.free.prior_sd * np.random.default_rng(3).standard_normal(n)
    return Truth(cell.free, np.zeros(1), values[None])
