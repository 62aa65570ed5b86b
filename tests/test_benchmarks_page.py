import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError

FOLDER = Path(__file__).parents[1] / "benchmarks"


def load(name: str) -> ModuleType:
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
        "benchmarks": [
            entry("bench_track", "test_one_session[3]", 2e-3),
            entry("bench_kernel", "test_numpy", 1.5e-6),
            entry("bench_kernel", "test_batch", 1.5e-3) | {"extra_info": {"name": "138 poses", "served": 1000}},
        ],
    }
    sized = {
        "points": [{"what": "identify", "size": n, "seconds": 1e-3 * n, "mebibytes": 2.0} for n in (10, 100)],
        "exponents": {"identify": 1.0, "minimise, by parameters": 2.0},
    }
    text = page.page(timed, sized, "sampler  ess\nours  3\n")
    assert text.index("beside NumPy and Pinocchio") < text.index("Tracking")
    assert "Processor seconds of one thread under Linux, Python 3.12.1." in text
    assert "A fast one" not in text
    assert "| one session[3] | 2 ms | 4 ms | 5 |" in text
    assert "| numpy | 1.5 us | 3 us | 5 |" in text
    assert "| 138 poses | 1.5 us | 3 us | 5 |" in text
    assert "| identify | 10 ms | 100 ms | 1.00 |" in text
    assert "| identify | 2 | 2 |" in text
    assert "Nothing grows faster than linearly in rows." in text
    assert "ours  3" in text
    sized["exponents"]["identify"] = 1.4
    assert "Slower than linear in rows: identify (1.40)." in page.page(None, sized, None)


def test_peers_stand_beside_ours_at_the_largest_common_size(page):
    ours = [point("Levenberg-Marquardt", n, 1e-5 * n) for n in (10, 100, 1000)]
    theirs = [point("Levenberg-Marquardt, lmfit", n, 5e-4 * n, peer=True) for n in (100, 1000, 3000)]
    sized = {
        "points": ours + theirs,
        "exponents": {"Levenberg-Marquardt": 1.0, "Levenberg-Marquardt, lmfit": 1.5},
        "absent": {"figaroh": "figaroh is not installed"},
        "machine": {"cores": 2, "gibibytes": 23.4, "others": 5.25},
    }
    text = page.page(None, sized, None, "spring")
    assert "| 1,000 rows | 10 ms, 2 MiB | 500 ms, 2 MiB | 50 |" in text
    assert "figaroh is not in this run: figaroh is not installed." in text
    assert "a machine with 2 cores and 23 GiB of memory, spring." in text
    assert "5.2 other programs" in text
    # A peer's cost is its own affair.
    assert "Nothing grows faster than linearly in rows." in text


def point(what: str, size: int, seconds: float, *, peer: bool = False) -> dict:
    return {"what": what, "size": size, "seconds": seconds, "mebibytes": 2.0, "of": "rows", "peer": peer}


def test_runs_of_parts_make_one_page(page):
    runs = [
        {"points": [point("identify", 10, 1.0)], "exponents": {"identify": 1.0}, "machine": {"cores": 2}},
        {"points": [point("observe", 10, 2.0)], "exponents": {"observe": 0.9}, "absent": {"lmfit": "no"}},
    ]
    whole = page.together(runs)
    assert [each["what"] for each in whole["points"]] == ["identify", "observe"]
    assert whole["exponents"] == {"identify": 1.0, "observe": 0.9}
    assert (whole["absent"], whole["machine"]) == ({"lmfit": "no"}, {"cores": 2})
    assert page.together([]) is None


def test_no_page_of_a_run_that_failed(page, tmp_path, monkeypatch):
    (tmp_path / "posterior.txt").touch()
    arguments = ["page", "--posterior", str(tmp_path / "posterior.txt"), "-o", str(tmp_path / "page.md")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(InputError, match="empty"):
        page.main()
    assert not (tmp_path / "page.md").exists()


def test_exponents_are_slopes_of_the_larger_sizes():
    measuring = load("measuring")
    sizes = np.array([10, 30, 100, 300, 1000, 3000])
    points = [measuring.Point("a", int(n), 5e-3 + 1e-4 * n, 0.0) for n in sizes]
    points += [measuring.Point("b", int(n), 1e-9 * n**2, 0.0) for n in sizes]
    found = measuring.exponents(points)
    assert 0.85 < found["a"] < 1.0
    assert found["b"] == pytest.approx(2.0)


def test_memory_is_the_most_that_was_allocated():
    measuring = load("measuring")
    found = measuring.timed("zeros", 1, lambda: np.ones(2**20))
    assert found.mebibytes == pytest.approx(8.0, abs=0.5)
    assert 0 < found.seconds < 1


def test_too_steep_is_what_costs_more_than_linearly():
    measuring = load("measuring")
    points = [measuring.Point("steep", n, 1e-6 * n**1.5, 0.0) for n in (10, 100, 1000)]
    points += [measuring.Point("flat", n, 1e-6 * n, 0.0) for n in (10, 100, 1000)]
    points += [measuring.Point("peer", n, 1e-6 * n**2, 0.0, peer=True) for n in (10, 100, 1000)]
    points += [measuring.Point("wide", n, 1e-6 * n**2, 0.0, "parameters") for n in (10, 100, 1000)]
    assert measuring.too_steep(points) == {"steep": pytest.approx(1.5)}
