"""Compilation of the kernels, and what to tell a user who waits for it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numba

_kernels: list[Any] = []


def compiled[F: Callable[..., Any]](function: F) -> F:
    """Compile a kernel with numba; the machine code is kept on disk for the next process.

    Products and sums may be fused; nothing else that changes results is allowed.
    """
    kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})(function)
    _kernels.append(kernel)
    return cast(F, kernel)


def needs_compilation() -> bool:
    """Whether some kernel has no machine code on disk that is newer than its source."""
    for kernel in _kernels:
        source = Path(kernel.py_func.__code__.co_filename)
        folder = Path(kernel.stats.cache_path)
        stored = folder.glob(f"{source.stem}.{kernel.py_func.__name__}-*.nbi")
        if not any(index.stat().st_mtime >= source.stat().st_mtime for index in stored):
            return True
    return False
