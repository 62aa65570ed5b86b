"""Compilation of the kernels, and what to tell a user who waits for it."""

import contextlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, cast

import numba


def compiled[F: Callable[..., Any]](function: F) -> F:
    """Compile a kernel and keep its machine code on disk; products and sums may be fused, nothing else is allowed."""
    kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})(function)
    drop_outdated(kernel)
    return cast(F, kernel)


def needs_compilation(*kernels: Any) -> bool:
    """Whether one of these kernels has no machine code on disk."""
    return any(not _stored(kernel) for kernel in kernels)


def _stored(kernel: Any) -> list[Path]:
    """Index files of a kernel's machine code."""
    source = Path(kernel.py_func.__code__.co_filename)
    return list(Path(kernel.stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__name__}-*.nbi"))


def drop_outdated(kernel: Any) -> None:
    """Forget machine code older than any kernel; numba looks at the kernel's own file only."""
    for index in _stored(kernel):
        with contextlib.suppress(OSError):
            if index.stat().st_mtime < _newest_source():
                index.unlink()


@cache
def _newest_source() -> float:
    """When the youngest kernel of the package was written: kernels of one room call those of another."""
    package = Path(__file__).parents[2]
    return max(source.stat().st_mtime for source in [*package.rglob("kernels.py"), *package.rglob("kernels/*.py")])
