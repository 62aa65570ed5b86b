"""Run the studies one after the other, and write a page of what the paper's figures and tables say beside ours.

    python studies/run_all.py [--only figure]

Longer studies run at a reduced size here; what they need for the numbers of the documentation stands there.
"""

import argparse
import html
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
OUTPUT = HERE / "output"
#: Each study with the options that keep it short: a script, or a command of the program.
STUDIES = (
    ("figure_09_10.py",),
    ("figure_11.py",),
    ("figure_12.py",),
    ("figure_13.py",),
    ("figure_14.py",),
    ("figure_15.py",),
    ("figure_16.py",),
    ("tables_2_to_7.py",),
    ("identifiability.py", "--replicates", "200"),
    ("fpcal", "study", "coverage", "--replicates", "100", "--anew", "-o", str(OUTPUT / "coverage.h5")),
    ("compare_models.py", "--truths", "1", "--paths", "axis"),
    ("posterior_sbc.py", "--replicates", "4", "-o", str(OUTPUT / "posterior_sbc.json")),
    ("planning.py", "accuracy", "--numbers", "12", "--draws", "16", "--truths", "20"),
    ("tracking.py", "--weeks", "10"),
    ("policies.py", "--weeks", "20", "--levels", "0.13"),
)
_LONGEST_S = 600


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="studies whose name holds this text")
    only = parser.parse_args().only
    chosen = [study for study in STUDIES if only in _name(study)]
    OUTPUT.mkdir(exist_ok=True)
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    failed, began = [], time.perf_counter()
    for number, study in enumerate(chosen, 1):
        start = time.perf_counter()
        program = ["-m", "fpcal_bayes"] if study[0] == "fpcal" else [str(HERE / study[0])]
        command = [sys.executable, *program, *study[1:]]
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=_LONGEST_S, check=False
            )
        except subprocess.TimeoutExpired:
            failed.append(_name(study))
            print(f"[{number} of {len(chosen)}] {' '.join(study)}: ended after {_LONGEST_S} s", flush=True)
            continue
        (OUTPUT / f"{_name(study)}.txt").write_text(done.stdout + done.stderr)
        spent, cpu = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        print(f"[{number} of {len(chosen)}, {spent:.0f} s, CPU {cpu:.0f} s] {' '.join(study)}", flush=True)
        print("  " + _last(done.stdout), flush=True)
        if done.returncode:
            failed.append(_name(study))
            print(f"  FAILED with status {done.returncode}: {_last(done.stderr)}", flush=True)
    write_page()
    print(f"{len(chosen)} studies in {time.perf_counter() - began:.0f} s -> {OUTPUT}/index.html")
    return 1 if failed else 0


def write_page() -> None:
    """The page of all figures that stand in the output."""
    found = [json.loads(path.read_text()) for path in sorted(OUTPUT.glob("*.json"))]
    parts = []
    for entry in found:
        # Other studies leave JSON of their own.
        if isinstance(entry, dict) and {"name", "opd", "paper", "here", "figure"} <= entry.keys():
            name, opd, paper, here, figure = (html.escape(entry[k]) for k in ("name", "opd", "paper", "here", "figure"))
            parts.append(
                f"<h2>{name} ({opd})</h2><p><b>Paper:</b> {paper}</p><p><b>Here:</b> {here}</p>"
                f'<img src="{figure}" alt="{name}">'
            )
    style = "body { font: 16px/1.5 sans-serif; margin: auto; max-width: 60rem; padding: 1rem } img { max-width: 100% }"
    (OUTPUT / "index.html").write_text(
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Figures and tables of the paper</title>'
        f"<style>{style}</style></head><body><h1>Figures and tables of the paper, and ours</h1>"
        f"{''.join(parts)}</body></html>\n",
        encoding="utf-8",
    )


def _name(study: tuple[str, ...]) -> str:
    return f"{study[1]}_{study[2]}" if study[0] == "fpcal" else Path(study[0]).stem


def _last(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip() and not line.strip().endswith((".png", ".svg"))]
    return lines[-1].strip() if lines else ""


if __name__ == "__main__":
    sys.exit(main())
