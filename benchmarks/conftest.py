"""One thread for everything that is timed, and a short table at the end."""

import os

# NumPy reads this when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"

from collections.abc import Callable
from typing import Any

import pytest

_SECONDS = pytest.StashKey[dict[str, tuple[float, float]]]()

#: Microseconds a parameter vector to compare with, and least ratio to the reference.
TARGETS = {
    "138 paper poses, kernel": (1.5, 30.0),
    "138 unrelated poses, kernel": (6.0, None),
    "69 x 21 Jacobian, batch of 100": (12.0, None),
    "inverse model, batch": (10.0, None),
    "inverse model, single call": (50.0, None),
}
REFERENCE = "138 paper poses, Pinocchio"

Timer = Callable[..., None]


@pytest.fixture
def timed(benchmark: Any, request: pytest.FixtureRequest) -> Timer:
    """Time a function that serves `vectors` parameter vectors a call, under a name of the final table."""

    def run(name: str, vectors: int, function: Callable[..., Any], *arguments: Any) -> None:
        # For the page of the docs.
        benchmark.extra_info.update(name=name, served=vectors)
        benchmark(function, *arguments)
        # Without timing (--benchmark-disable) the function runs once and there are no figures.
        if benchmark.stats is not None:
            figures = benchmark.stats.stats
            seconds = request.config.stash.setdefault(_SECONDS, {})
            seconds[name] = (figures.min / vectors, figures.median / vectors)

    return run


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    seconds = config.stash.get(_SECONDS, {})
    if not seconds:
        return
    terminalreporter.section("microseconds a parameter vector, one core")
    terminalreporter.line(f"{'':34}{'min':>9}{'median':>9}{'target':>9}{'speed / Pinocchio':>20}{'target':>9}")
    reference = seconds.get(REFERENCE)
    for name, (least, median) in seconds.items():
        target, least_ratio = TARGETS.get(name, (None, None))
        ratio = f"{reference[0] / least:.1f}" if reference else ""
        terminalreporter.line(
            f"{name:34}{least * 1e6:9.2f}{median * 1e6:9.2f}{_text(target):>9}{ratio:>20}{_text(least_ratio):>9}"
        )


def _text(number: float | None) -> str:
    return "" if number is None else f"{number:g}"
