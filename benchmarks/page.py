"""Write the benchmarks page of the docs from what was measured: kernels, fits and peers, and cost against size.

python -m pytest benchmarks --benchmark-only --benchmark-json=bench.json
python benchmarks/scaling.py --json scaling.json
python benchmarks/bench_posterior.py > posterior.txt
python benchmarks/page.py --pytest bench.json --scaling scaling.json --posterior posterior.txt -o docs/benchmarks.md
"""

import argparse
import json
from pathlib import Path
from typing import Any

from fpcal_bayes.files import write_text

#: Titles of the groups, by the file they are timed in; the peers stand in the same file.
GROUPS = {
    "bench_kernel": "Cavity lengths and Jacobian, beside NumPy and Pinocchio",
    "bench_inference": "Levenberg-Marquardt and observability, beside lmfit",
    "bench_control": "Inverse model, beside Pinocchio with a damped Newton",
    "bench_plan": "Planning",
    "bench_track": "Tracking, beside statsmodels",
}
#: Up to this size of an exponent the cost counts as linear.
LINEAR = 1.1


def duration(seconds: float) -> str:
    """A time with three digits and a unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table; the first column holds text."""
    lines = [f"| {' | '.join(header)} |", "|---|" + "---:|" * (len(header) - 1)]
    return lines + [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]


def timings(measured: dict[str, Any]) -> list[str]:
    """Tables of what pytest-benchmark measured, a file each."""
    lines: list[str] = []
    files: dict[str, list[list[str]]] = {}
    for entry in measured["benchmarks"]:
        file = Path(entry["fullname"].partition("::")[0]).stem
        name = entry["name"].removeprefix("test_").replace("_", " ")
        stats = entry["stats"]
        row = [name, duration(stats["min"]), duration(stats["median"]), str(stats["rounds"])]
        files.setdefault(file, []).append(row)
    for file in sorted(files, key=lambda name: (name not in GROUPS, name)):
        title = GROUPS.get(file, file.removeprefix("bench_").replace("_", " "))
        lines += [f"## {title}", "", *table(["", "least", "median", "rounds"], files[file]), ""]
    return lines


def scaling(measured: dict[str, Any]) -> list[str]:
    """Tables of time and memory against size, and the exponents."""
    lines = ["## Time and memory against size", ""]
    lines += ["Processor seconds of one thread, and the largest allocation.", ""]
    by_parameters = {what for what in measured["exponents"] if "by parameters" in what}
    for title, chosen in (
        ("rows", [p for p in measured["points"] if p["what"] not in by_parameters]),
        ("free parameters", [p for p in measured["points"] if p["what"] in by_parameters]),
    ):
        sizes = sorted({point["size"] for point in chosen})
        found = {(point["what"], point["size"]): point for point in chosen}
        names = list(dict.fromkeys(point["what"] for point in chosen))
        rows = []
        for name in names:
            cells = [found.get((name, size)) for size in sizes]
            texts = ["" if c is None else f"{duration(c['seconds'])}, {c['mebibytes']:.3g} MiB" for c in cells]
            slope = measured["exponents"].get(name)
            rows.append([name, *texts, "" if slope is None else f"{slope:.2f}"])
        lines += [*table([title, *map(str, sizes), "exponent"], rows), ""]
    over = [
        f"{name} ({slope:.2f})"
        for name, slope in measured["exponents"].items()
        if slope > LINEAR and name not in by_parameters
    ]
    lines.append(
        f"Slower than linear in rows: {', '.join(over)}." if over else "Nothing grows faster than linearly in rows."
    )
    return [*lines, ""]


def machine(measured: dict[str, Any]) -> str:
    """What it was measured on."""
    about = measured.get("machine_info", {})
    cpu = about.get("cpu", {})
    name = cpu.get("brand_raw", about.get("processor", "unknown processor"))
    return f"One thread of {name}, {about.get('system', '')}, Python {about.get('python_version', '')}."


def page(timed: dict[str, Any] | None, sized: dict[str, Any] | None, posterior: str | None) -> str:
    """The page as Markdown."""
    lines = ["# Benchmarks", "", "Made by `make bench`; nothing on this page is written by hand.", ""]
    if timed is not None:
        lines += [machine(timed), "", *timings(timed)]
    if posterior is not None:
        lines += ["## Posterior, beside NUTS and emcee's own moves", "", "```", posterior.strip("\n"), "```", ""]
    if sized is not None:
        lines += scaling(sized)
    return "\n".join(lines).rstrip("\n") + "\n"


def read(path: Path | None) -> dict[str, Any] | None:
    """A JSON file, if there is one."""
    return None if path is None else json.loads(path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pytest", type=Path, help="JSON of pytest-benchmark")
    parser.add_argument("--scaling", type=Path, help="JSON of scaling.py")
    parser.add_argument("--posterior", type=Path, help="what bench_posterior.py prints")
    parser.add_argument("-o", dest="output", type=Path, required=True, help="page to write")
    options = parser.parse_args()
    posterior = None if options.posterior is None else options.posterior.read_text()
    write_text(options.output, page(read(options.pytest), read(options.scaling), posterior))


if __name__ == "__main__":
    main()
