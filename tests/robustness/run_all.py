"""Run every program of this folder for a bounded time, and say what each counted.

    python tests/robustness/run_all.py [--minutes 20]

No program needs the network. Each runs longer, by itself, as its first lines say.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
CASE_A = HERE.parent / "data" / "case_a.csv"
#: Each program with its options, and its share of the time.
PROGRAMS = (
    (("faults.py", "--faults", "400"), 0.12),
    (("faults.py", "--faults", "300", "--kinds", "killed", "--even"), 0.12),
    (("faults.py", "--faults", "2000", "--kinds", "lexical", "--quick"), 0.1),
    (("semantic.py", "--draws", "2"), 0.1),
    (("../rig_faults.py", "150"), 0.09),
    (("rig_weeks.py", "--weeks", "2", "--days", "0.5"), 0.05),
    (("serve_load.py", "--reads", "2000"), 0.1),
    (("posterior_kills.py", str(CASE_A), "--kills", "12", "--draws", "1000"), 0.12),
    (("determinism.py",), 0.15),
    (("soak.py", "--weeks", "2", "--kills", "1"), 0.15),
    (("loop.py", "--hours", "48", "--kills", "30"), 0.1),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20.0, help="after which what still runs has failed")
    minutes = parser.parse_args().minutes
    failed, began = [], time.monotonic()
    for (name, *options), share in PROGRAMS:
        # Faults are as many as the time allows; the others must come to their end.
        limited = [*options, "--minutes", f"{0.8 * share * minutes:g}"] if name == "faults.py" else options
        start, limit = time.monotonic(), 60.0 * share * minutes
        try:
            done = subprocess.run(
                [sys.executable, str(HERE / name), *limited],
                capture_output=True, text=True, timeout=limit, check=False,
            )  # fmt: skip
            said, good = (done.stdout.splitlines() or [""])[-1], done.returncode == 0
            if not good:
                print(done.stdout + done.stderr, file=sys.stderr)
        except subprocess.TimeoutExpired:
            said, good = f"not done after {limit:.0f} s", False
        failed += [] if good else [name]
        print(f"{name:20} {time.monotonic() - start:5.0f} s  {'' if good else 'FAILED: '}{said}", flush=True)
    print(
        f"{len(PROGRAMS) - len(failed)} of {len(PROGRAMS)} programs in {time.monotonic() - began:.0f} s found no fault"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
