"""Shared by all tests: settings, the reference case, and random cells for property tests."""

import os

# Tests run side by side; each keeps to one thread. NumPy reads this when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import csv
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from path_length import path_length

from fpcal_bayes.cli import arguments
from fpcal_bayes.infer.fit import identify as identify_module
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell, make_parameters
from fpcal_bayes.model.cell.joints import Joint
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, UNITS

# Tests are of a perfect mechanism unless they ask for `--mechanics stated`: numbers from elsewhere are of such a one.
arguments.MECHANICS = "none"

DATA = Path(__file__).parent / "data"

# The same examples on every run: a failure is never a matter of luck. `--hypothesis-profile explore` draws new ones.
settings.register_profile(
    "repeatable", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("explore", deadline=None, max_examples=1000, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("repeatable")


@dataclass(frozen=True)
class ReferenceCase:
    """Case A, computed by a program that shares no code with this one."""

    content: dict[str, Any]
    q_start: np.ndarray
    q_end: np.ndarray

    def truth(self, cell: Cell) -> np.ndarray:
        """The true parameters, in internal units."""
        return cell.free.from_mapping(self.content["truth"])


@pytest.fixture(scope="session")
def femto() -> Cell:
    return load_cell(mechanics="none")


@pytest.fixture(scope="session")
def case_a(femto: Cell) -> ReferenceCase:
    with (DATA / "case_a.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    ends = []
    for end in ("start", "end"):
        names = [f"{name}_{end}_{unit}" for name, unit in (c.split("_") for c in femto.joint_columns)]
        ends.append(np.array([[float(row[name]) for name in names] for row in rows]) * femto.joint_scales)
    return ReferenceCase(json.loads((DATA / "case_a.json").read_text()), *ends)


@pytest.fixture(scope="class")
def minima_only() -> Iterator[None]:
    """Identifications without the look at axes that count the other way: it is tried elsewhere, and is most of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identify_module, "axis_rivals", lambda *_: [])
        yield


#: No shared folder takes so long to make, in s, also where many programs share the cores.
_PATIENCE_S = 1800.0


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """A function `(name, make)` that gives a folder which `make` filled once, however many workers run the tests.

    Tests read such a folder and write nothing into it.
    """
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    def shared(name: str, make: Callable[[Path], None]) -> Path:
        folder, made, failed = root / f"shared-{name}", root / f"{name}.made", root / f"{name}.failed"
        try:
            folder.mkdir()
        except FileExistsError:
            end = time.monotonic() + _PATIENCE_S
            while not made.exists():
                assert not failed.exists(), f"{name}: could not be made by the worker that began"
                assert time.monotonic() < end, f"{name}: not made in {_PATIENCE_S:.0f} s"
                time.sleep(0.05)
            return folder
        try:
            make(folder)
        except BaseException:
            failed.touch()
            raise
        made.touch()
        return folder

    return shared


@dataclass(frozen=True)
class RandomCell:
    """A random cell with all its parameters free, their values, and poses whose cavity length is well defined."""

    cell: Cell
    values: np.ndarray
    poses: np.ndarray

    @cached_property
    def model(self) -> CavityModel:
        return CavityModel.of(self.cell)

    @cached_property
    def vector(self) -> np.ndarray:
        return self.model.vector(self.values)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Cavity lengths by 4x4 products."""
        return np.array([path_length(self.cell, self.vector, q) for q in self.poses])

    @cached_property
    def tolerance(self) -> float:
        """What rounding may change in a cavity length."""
        return 1e-13 * (1e4 + float(np.abs(self.lengths).max())) / 0.05


def well_defined(cell: Cell, vector: np.ndarray, q: np.ndarray) -> bool:
    """Whether light meets the mirror, not along its surface and not in the fibre end, where |distance| has a kink."""
    mirror = chain.mirror_pose(cell, vector, q)
    normal, to_mirror = mirror[:3, 2], mirror[:3, 3] - chain.fibre_in_world(vector)[:3, 3]
    return bool(abs(normal @ chain.optical_axis(cell, vector)) > 0.05 and abs(normal @ to_mirror) > 1.0)


_SPREAD = {"d": 200.0, "r": 200.0, "z_et": 100.0, "gain": 0.05, "runout_cos": 5.0, "runout_sin": 5.0} | dict.fromkeys(
    ("x_wf", "y_wf", "z_wf"), 1000.0
)


def _draw_value(stem: str, right_angles: bool, random: np.random.Generator) -> float:
    if UNITS[stem] != "deg":
        return _SPREAD[stem] * random.uniform(-1.0, 1.0)
    if right_angles:
        return np.pi / 2 * random.integers(-1, 3) + np.radians(random.normal())
    return random.uniform(-np.pi, np.pi)


@st.composite
def random_cells(draw: st.DrawFn, n_poses: int = 6, min_joints: int = 1, max_free: int = 80) -> RandomCell:
    """Chains of up to 8 joints in any order, any parameters in use, both path models and optical axes."""
    kinds = draw(st.lists(st.sampled_from(["prismatic", "revolute"]), min_size=min_joints, max_size=8))
    stems = draw(st.sets(st.sampled_from(LINK_SLOTS)))
    right_angles = draw(st.booleans())
    opd, optical_axis = draw(st.sampled_from(["axis", "perpendicular"])), draw(st.sampled_from(["minus-y", "z"]))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    candidates = [
        f"{stem}_{i}"
        for i, kind in enumerate(kinds, 1)
        for stem in LINK_SLOTS
        if stem in stems and not (kind == "prismatic" and stem.startswith("runout"))
    ]
    chosen = [*random.permutation(candidates)[: max(0, max_free - len(EXTRINSICS))].tolist(), *EXTRINSICS]
    entries = dict.fromkeys(chosen, (0.0, 1.0, False))
    joints = tuple(Joint(kind, -np.inf, np.inf, 0.0, None) for kind in kinds)
    cell = Cell("random", joints, make_parameters(entries, len(kinds)), 1.56, opd, optical_axis)
    model = CavityModel.of(cell)

    turn = random.choice([np.radians(5.0), np.pi])
    q = np.where(cell.revolute, turn, 150.0) * random.uniform(-1.0, 1.0, (4 * n_poses, len(kinds)))
    # Half of the poses share their revolute joints, as in a campaign.
    q[1::2] = np.where(cell.revolute, q[0], q[1::2])
    for _ in range(100):
        values = np.array([_draw_value(_stem(p.name), right_angles, random) for p in cell.free])
        vector = model.vector(values)
        good = list(islice((pose for pose in q if well_defined(cell, vector, pose)), n_poses))
        if len(good) == n_poses:
            return RandomCell(cell, values, np.array(good))
        # Mirror and light may stand across each other for every pose: right angles cannot be kept then.
        right_angles = False
    raise AssertionError("no cell whose mirror faces the fibre was found")


def _stem(name: str) -> str:
    return name if name in EXTRINSICS else name.rpartition("_")[0]
