"""Is the true peak to peak of a task where its prediction says? The package's study of coverage, in this process.

Each replicate draws a truth, measures sweeps on it, identifies, lets the controller make each task's joint path with
the estimate, and compares the true peak to peak with the predicted bands: of draws, as an estimate of `fpcal identify`
holds them and `fpcal task-error` uses them, and to first order from the covariance. `fpcal study coverage` runs the
same on all cores or on a cluster.

    python studies/task_coverage.py --replicates 1000 [--protocol paper|paper-mid] [--opd axis|perpendicular]
"""

import argparse
import time

import numpy as np

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import PROTOCOLS, protocol_by_name
from fpcal_bayes.study.coverage import SHARES, Coverage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicates", type=int, default=1000)
    parser.add_argument("--protocol", choices=PROTOCOLS, default="paper")
    parser.add_argument("--opd", choices=("axis", "perpendicular"), default="axis")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    began = time.perf_counter()
    cell = load_cell(opd=options.opd)
    study = Coverage(cell=cell, seed=options.seed, plan=protocol_by_name(options.protocol, cell))
    found = [study.replicate(number) for number in range(options.replicates)]
    summary = study.summary({name: np.array([each[name] for each in found]) for name in study.shapes()})

    print(f"{options.protocol}, opd {options.opd}: {summary.title}")
    print(f"{'task':10}{'method':>12}{'n':>7}" + "".join(f"{100 * share:10.0f}" for share in SHARES))
    for row in summary.rows:
        inside = [row[f"in_{100 * share:g}_percent"] for share in SHARES]
        print(f"{row['task']:10}{row['method']:>12}{row['n']:7}" + "".join(f"{share:10.1f}" for share in inside))
    for sentence in (*summary.sentences, *summary.warnings):
        print(sentence)
    print(f"{options.replicates} replicates in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
