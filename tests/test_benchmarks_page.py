import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


def load(name: str) -> ModuleType:
    import sys

    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def page() -> ModuleType:
    return load("page")


def entry(file: str, name: str, least: float) -> dict:
    stats = {"min": least, "median": 2 * least, "rounds": 5}
    return {"fullname": f"benchmarks/{file}.py::{name}", "name": name, "stats": stats}


def test_page(page):
    timed = {
        "machine_info": {"cpu": {"brand_raw": "A fast one"}, "system": "Linux", "python_version": "3.12.1"},
        "benchmarks": [entry("bench_track", "test_one_session[3]", 2e-3), entry("bench_kernel", "test_numpy", 1.5e-6)],
    }
    sized = {
        "points": [{"what": "identify", "size": n, "seconds": 1e-3 * n, "mebibytes": 2.0} for n in (10, 100)],
        "exponents": {"identify": 1.0, "minimise, by parameters": 2.0},
    }
    text = page.page(timed, sized, "sampler  ess\nours  3\n")
    assert text.index("beside NumPy and Pinocchio") < text.index("Tracking")
    assert "| one session[3] | 2 ms | 4 ms | 5 |" in text
    assert "| numpy | 1.5 us | 3 us | 5 |" in text
    assert "| identify | 10 ms, 2 MiB | 100 ms, 2 MiB | 1.00 |" in text
    assert "Nothing grows faster than linearly in rows." in text
    assert "ours  3" in text
    sized["exponents"]["identify"] = 1.4
    assert "Slower than linear in rows: identify (1.40)." in page.page(None, sized, None)


def test_exponents_are_slopes_of_the_larger_sizes():
    scaling = load("scaling")
    sizes = np.array([10, 30, 100, 300, 1000, 3000])
    points = [scaling.Point("a", int(n), 5e-3 + 1e-4 * n, 0.0) for n in sizes]
    points += [scaling.Point("b", int(n), 1e-9 * n**2, 0.0) for n in sizes]
    found = scaling.exponents(points)
    assert 0.85 < found["a"] < 1.0
    assert found["b"] == pytest.approx(2.0)
