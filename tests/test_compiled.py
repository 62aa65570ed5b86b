"""Compilation: what is kept on disk, and whether the next process has to wait."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fpcal_bayes.model.kernels.compile import compiled, drop_outdated, needs_compilation
from fpcal_bayes.model.kernels.lengths import is_angle
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, UNITS

PROGRAM = """
import numpy as np
from fpcal_bayes.infer.fit.kernels import whiten_groups
from fpcal_bayes.model.kernels.compile import needs_compilation
before = needs_compilation(whiten_groups)
rows, one = np.array([[[7.0]]]), np.ones((1, 1, 1))
whiten_groups(rows, np.zeros((1, 1), dtype=np.int64), 2.0 * one[0], one, 0.0 * one, 3.0 * one[0])
print(before, needs_compilation(whiten_groups), float(rows[0, 0, 0]))
"""


@pytest.mark.slow
def test_second_process_finds_the_machine_code(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    said = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    ]
    assert [run[:2] for run in said] == [["True", "False"], ["False", "False"]]
    assert said[0][2] == said[1][2]
    assert float(said[0][2]) == 42.0


def test_stored_code_older_than_any_kernel_source_is_dropped(tmp_path: Path) -> None:
    """Only time stamps are compared: a stand-in kernel with a source and a stored file will do."""
    code = SimpleNamespace(co_filename=str(tmp_path / "kernel.py"))
    function = SimpleNamespace(__name__="carry", __code__=code)
    kernel = SimpleNamespace(py_func=function, stats=SimpleNamespace(cache_path=str(tmp_path)))
    other, stored = tmp_path / "kernel_other.py", tmp_path / "kernel.carry-12.py312.nbi"
    (tmp_path / "kernel.py").touch()
    assert needs_compilation(kernel)
    stored.touch()
    os.utime(tmp_path / "kernel.py", (1000, 1000))
    drop_outdated(kernel)
    assert not needs_compilation(kernel)
    # A kernel that this one calls has changed.
    other.touch()
    os.utime(stored, (1100, 1100))
    drop_outdated(kernel)
    assert needs_compilation(kernel)


def test_angles_are_the_parameters_in_degrees() -> None:
    for n_links in (1, 6):
        names = [stem for _ in range(n_links) for stem in LINK_SLOTS] + list(EXTRINSICS)
        assert [is_angle(slot, n_links) for slot in range(len(names))] == [UNITS[name] == "deg" for name in names]


def test_fused_sums_keep_nan_and_infinity() -> None:
    """Contraction is allowed; assuming that numbers are finite is not."""

    def add(x: float, y: float) -> bool:
        total = x + y
        return total == total

    kernel = compiled(add)
    assert kernel(1.0, 2.0)
    assert not kernel(np.inf, -np.inf)
    assert not kernel(np.nan, 0.0)
