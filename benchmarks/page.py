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

from fpcal_bayes.core import read_text, write_text

#: Titles of the groups, by the file they are timed in; the peers stand in the same file.
GROUPS = {
    "bench_kernel": "Cavity lengths and Jacobian, beside NumPy and Pinocchio",
    "bench_inference": "Levenberg-Marquardt and observability, beside lmfit",
    "bench_control": "Inverse model, beside Pinocchio with a damped Newton",
    "bench_plan": "Planning",
    "bench_track": "Tracking",
    "bench_start": "Whole programs",
}
#: What we and another program do with the same input, by name of the measurements, and what is to be known about it.
PAIRS = (
    ("lengths", "forward kinematics, Pinocchio", "Pinocchio gives poses, one call each"),
    ("lengths and Jacobian by 21 parameters", "Jacobian by 6 joints, Pinocchio", "joints in place of parameters"),
    (
        "lengths and Jacobian by 21 parameters",
        "Jacobian by 36 placements, figaroh",
        "the mirror's pose: figaroh fits poses and points, but no cavity length",
    ),
    ("Levenberg-Marquardt", "Levenberg-Marquardt, lmfit", "our residuals, its finite differences"),
    ("inverse model", "inverse model, Pinocchio and Newton", "all solutions here, the nearest there"),
    (
        "filter, 6 linear rows a step",
        "filter, 6 linear rows a step, statsmodels",
        "compiled and linear only; ours iterates sweeps that are not linear",
    ),
)
#: Up to this size of an exponent the cost counts as linear.
LINEAR = 1.1

Json = dict[str, Any]


def duration(seconds: float) -> str:
    """A time with three digits and a unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{three(seconds / size)} {unit}"
    return f"{three(seconds * 1e9)} ns"


def three(value: float) -> str:
    """A number with three digits, without exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table; the first column holds text."""
    lines = [f"| {' | '.join(header)} |", "|---|" + "---:|" * (len(header) - 1)]
    return lines + [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]


def timings(measured: Json) -> list[str]:
    """Tables of what pytest-benchmark measured, a file each."""
    lines = ["## Single operations", ""]
    lines += ["Least and median of a call; a parameter vector or pose, where a call serves many of them.", ""]
    files: dict[str, list[list[str]]] = {}
    for entry in measured["benchmarks"]:
        file = Path(entry["fullname"].partition("::")[0]).stem
        about, stats = entry.get("extra_info", {}), entry["stats"]
        name = about.get("name", entry["name"].removeprefix("test_").replace("_", " "))
        times = [duration(stats[which] / about.get("served", 1)) for which in ("min", "median")]
        row = [name, *times, str(stats["rounds"])]
        files.setdefault(file, []).append(row)
    for file in sorted(files, key=lambda name: (name not in GROUPS, name)):
        title = GROUPS.get(file, file.removeprefix("bench_").replace("_", " "))
        lines += [f"### {title}", "", *table(["", "least", "median", "rounds"], files[file]), ""]
    return lines


def peers(measured: Json) -> list[str]:
    """What other programs need for the same input, at the largest size that both were given."""
    found = {(point["what"], point["size"]): point for point in measured["points"]}
    rows = []
    for ours, theirs, remark in PAIRS:
        sizes = [size for what, size in found if what == theirs and (ours, size) in found]
        if not sizes:
            continue
        own, other = found[ours, max(sizes)], found[theirs, max(sizes)]
        times = [f"{duration(p['seconds'])}, {three(p['mebibytes'])} MiB" for p in (own, other)]
        ratio = three(other["seconds"] / own["seconds"])
        rows.append([ours, theirs, f"{max(sizes):,} {own.get('of', 'rows')}", *times, ratio, remark])
    absent = [f"{name} is not in this run: {reason}." for name, reason in measured.get("absent", {}).items()]
    if not rows:
        return absent
    heads = ["here", "peer", "size", "here", "peer", "peer / here", ""]
    lines = ["## Beside other programs", "", "The same run; every peer is held to our result before it is timed.", ""]
    return [*lines, *table(heads, rows), "", *absent, *([""] if absent else [])]


def scaling(measured: Json) -> list[str]:
    """Tables of time and of memory against size, and the exponents."""
    points, slopes = measured["points"], measured["exponents"]
    counted = {point["what"]: point.get("of", "rows") for point in points}
    lines = ["## Time and memory against size", ""]
    lines += [
        "Memory is the most that Python and NumPy had allocated at once (what a peer's own "
        "C++ allocates is not seen). An exponent is the slope of log time over the larger half of the sizes; how "
        "many steps a fit takes varies from one size to the next.",
        "",
    ]
    over = [
        f"{name} ({slope:.2f})"
        for name, slope in slopes.items()
        if slope > LINEAR and counted.get(name) not in (None, "parameters") and not is_peer(points, name)
    ]
    if any(of == "rows" for of in counted.values()):
        lines += [
            f"Slower than linear in rows: {', '.join(over)}." if over else "Nothing grows faster than linearly in rows."
        ]
        lines += [""]
    for of in dict.fromkeys(counted.values()):
        chosen = [point for point in points if counted[point["what"]] == of]
        sizes = sorted({point["size"] for point in chosen})
        found = {(point["what"], point["size"]): point for point in chosen}
        lines += [f"### Against the number of {of}", ""]
        for head, show in (("time", "seconds"), ("memory in MiB", "mebibytes")):
            rows = []
            for name in dict.fromkeys(point["what"] for point in chosen):
                cells = [found.get((name, size)) for size in sizes]
                write = duration if show == "seconds" else three
                texts = ["" if cell is None else write(cell[show]) for cell in cells]
                slope = [f"{slopes[name]:.2f}" if name in slopes else ""] if show == "seconds" else []
                rows.append([name, *texts, *slope])
            slope_head = ["exponent"] if show == "seconds" else []
            lines += [*table([head, *(f"{size:,}" for size in sizes), *slope_head], rows), ""]
    return lines


def is_peer(points: list[Json], name: str) -> bool:
    """Whether a measurement is of another program."""
    return any(point.get("peer", False) for point in points if point["what"] == name)


def machine(timed: Json | None, sized: Json | None, date: str | None) -> str:
    """What kind of machine it was measured on."""
    about = {} if timed is None else timed.get("machine_info", {})
    kind = {} if sized is None else sized.get("machine", {})
    parts = ["Processor seconds of one thread"]
    if kind:
        parts.append(f"of a machine with {kind['cores']} cores and {kind['gibibytes']:.0f} GiB of memory")
    if about:
        parts.append(f"under {about.get('system', '')}, Python {about.get('python_version', '')}")
    text = " ".join(parts) + (f", {date}" if date else "") + "."
    if kind.get("others", 0.0) > 0.5:
        text += (
            f" On average {kind['others']:.1f} other programs wanted a core meanwhile: processor seconds, of which all "
            "times on this page are, are somewhat longer than on an idle machine, whose caches nobody else fills."
        )
    return text


def page(timed: Json | None, sized: Json | None, posterior: str | None, date: str | None = None) -> str:
    """The page as Markdown."""
    lines = ["# Benchmarks", "", "Made by `make bench`; nothing on this page is written by hand.", ""]
    if timed is not None or sized is not None:
        lines += [machine(timed, sized, date), ""]
    if sized is not None:
        lines += [*peers(sized), *scaling(sized)]
    if posterior is not None:
        lines += ["## Posterior, beside NUTS and emcee's own moves", ""]
        lines += ["```text", *(line.rstrip() for line in posterior.strip("\n").splitlines()), "```", ""]
    if timed is not None:
        lines += timings(timed)
    return "\n".join(lines).rstrip("\n") + "\n"


def read(path: Path | None) -> Json | None:
    """A JSON file, if there is one."""
    return None if path is None else json.loads(read_text(path))


def together(runs: list[Json]) -> Json | None:
    """Several runs of scaling.py as one; None of none. The machine is that of the first."""
    if not runs:
        return None
    points = [point for run in runs for point in run["points"]]
    slopes, absent = ({k: v for run in runs for k, v in run.get(key, {}).items()} for key in ("exponents", "absent"))
    return runs[0] | {"points": points, "exponents": slopes, "absent": absent}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pytest", type=Path, help="JSON of pytest-benchmark")
    parser.add_argument("--scaling", type=Path, nargs="+", default=[], help="JSON of scaling.py, of each run of parts")
    parser.add_argument("--posterior", type=Path, help="what bench_posterior.py prints")
    parser.add_argument("--date", help="of the measurement")
    parser.add_argument("-o", dest="output", type=Path, required=True, help="page to write")
    options = parser.parse_args()
    # A file that is missing or empty belongs to a run that failed: no page is made of it.
    posterior = None if options.posterior is None else read_text(options.posterior)
    sized = together([content for path in options.scaling if (content := read(path))])
    write_text(options.output, page(read(options.pytest), sized, posterior, options.date))


if __name__ == "__main__":
    main()
