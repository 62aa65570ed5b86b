"""How honest are readings of traces with a defect? Each has one, drawn at random; the mirror's own change is true.

Sweeps along the optical axis of 4 to 200 um, from a generator that shares nothing with the reader but the cell's
cavity length. Defects: none, a mirror that sets out late or stops early (0.05 to 2 um), one that lags (with rest at the
end), a stage that runs unevenly under a column of commanded positions, or with a ripple, a late one with a ripple, a
converter of 8 to 16 bits, a laser that hops, a jump by a whole fringe within one sample. Twenty sweeps are a recording
of one stage, in which all have the defect, or a share of them (`--share`). Printed for each: how many are accepted, the
variance of the standardised errors of those, and how many lie beyond six standard deviations.

    python studies/fringe_defects.py [--traces 1000] [--seed 0] [--share 0.5]
"""

import argparse

import numpy as np

from fpcal_bayes.fringes import read_index
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, Trace, TraceIndex, join, paper_truth, single_sweep
from fpcal_bayes.model import CavityModel, Cell

KINDS = ("clean", "late", "lag", "uneven", "bits", "hop", "whole fringe", "ripple", "early", "late ripple")
#: Traces of one recording.
BATCH = 20


def drawn(
    cell: Cell, model: CavityModel, values: np.ndarray, kind: str, random: np.random.Generator
) -> tuple[Sweeps, Trace, float]:
    """A sweep, its trace, and the change that the mirror made."""
    travel = np.exp(random.uniform(np.log(4.0), np.log(200.0)))
    start = random.uniform(-100.0, 100.0 - travel)
    ends = (start, start + travel) if random.random() < 0.5 else (start + travel, start)
    sweep = single_sweep(cell, 2, *ends)
    n = int(np.exp(random.uniform(np.log(12.0), np.log(60.0))) * travel / 0.78) + 40
    rest = int(0.3 * n) if kind == "lag" else 0
    turn, begin = 2.0 * np.pi * random.integers(3, 12), random.uniform(0.0, 2.0 * np.pi)
    time = np.linspace(0.0, 1.0, n)
    done = time + 0.1 / turn * (np.sin(turn * time + begin) - np.sin(begin))
    done[-1] = 1.0
    commanded = np.concatenate([done, np.ones(rest)])
    place = commanded.copy()
    if kind.startswith("late"):
        place = np.maximum(place, random.uniform(0.05, 2.0) / travel)
    elif kind == "early":
        place = np.minimum(place, 1.0 - random.uniform(0.05, 2.0) / travel)
    elif kind == "lag":
        share = np.exp(-1.0 / (n * random.uniform(0.003, 0.03)))
        for i in range(1, len(place)):
            place[i] = share * place[i - 1] + (1.0 - share) * commanded[i]
    elif kind == "uneven":
        commanded = time
        bend = random.normal(size=3) * np.minimum(0.1, 0.01 * travel) / travel
        place = done + sum(b * np.sin(np.pi * (k + 1) * time / 2.0) for k, b in enumerate(bend))
    if kind.endswith("ripple"):
        turns = travel / np.exp(random.uniform(np.log(2.0), np.log(20.0)))
        wave = random.uniform(0.002, 0.03) * np.sin(2.0 * np.pi * turns * place + random.uniform(0.0, 6.28))
        place = place + wave / travel
    q = sweep.q_start[0] + place[:, None] * (sweep.q_end - sweep.q_start)[0]
    length = model.predict(values, model.pose_rows(q))
    phase = 4.0 * np.pi / cell.wavelength * length
    if kind == "hop":
        phase = phase + random.choice([-1.0, 1.0]) * random.uniform(0.1, 3.0) * (
            np.arange(len(q)) > random.uniform(0.1, 0.9) * n
        )
    elif kind == "whole fringe":
        phase = phase + 2.0 * np.pi * (np.arange(len(q)) > random.uniform(0.1, 0.9) * n)
    at = np.linspace(0.0, 1.0, len(q))
    gain = 1.0 + 0.1 * random.normal() * (at - 0.5) + 0.05 * random.normal() * (at - 0.5) ** 2
    signal = 2.0 + 0.05 * random.normal() * at + gain * np.cos(phase + random.uniform(0.0, 6.28))
    signal += 0.01 * np.cos(2.0 * phase + random.uniform(0.0, 6.28)) + 0.01 * random.normal(size=len(q))
    step = 5.0 / (2.0 ** (random.integers(8, 17) if kind == "bits" else 16) - 1)
    joint = ends[0] + commanded * (ends[1] - ends[0])
    return sweep, Trace(0.005 * np.arange(len(q)), joint, np.rint(signal / step) * step), float(length[-1] - length[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--traces", type=int, default=1000, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=1.0, help="of the traces of a recording that have the defect")
    parser.add_argument("--list", action="store_true", help="readings beyond four standard deviations, one by one")
    options = parser.parse_args()
    cell = load_cell(mechanics="none")
    paper = paper_truth(cell)
    model, sds = CavityModel.of(cell, paper.parameters), np.array([p.prior_sd for p in paper.parameters])
    everything = []
    for kind in options.kinds:
        scores, refused = [], {}
        for seed in range(options.seed, options.seed + max(1, options.traces // BATCH)):
            random = np.random.default_rng([seed, KINDS.index(kind)])
            values = paper.at(0.0) + 0.3 * sds * random.standard_normal(len(sds))
            has_it = [options.share == 1.0 or random.random() < options.share for _ in range(BATCH)]
            made = [drawn(cell, model, values, kind if has else "clean", random) for has in has_it]
            index = TraceIndex.of(join([sweep for sweep, *_ in made]), [trace for _, trace, _ in made])
            for reading, (_, trace, true) in zip(read_index(index, cell).readings, made, strict=True):
                if not reading.good:
                    why = "".join(c for c in reading.refused or reading.doubt if not c.isdigit())[:60]
                    refused[why] = refused.get(why, 0) + 1
                    continue
                error = abs(reading.dl) - abs(true)
                scores.append(error / reading.sigma)
                if options.list and abs(scores[-1]) > 4.0:
                    print(
                        f"  {kind} seed {seed}: travel {true:.2f}, error {1e3 * error:.1f} nm, sigma "
                        f"{1e3 * reading.sigma:.2f}, late {reading.late:.3f}, uneven {reading.uneven} "
                        f"{len(reading.profile)}, {len(trace)} samples"
                    )
        scores, lost = np.array(scores), sum(refused.values())
        everything.append(scores)
        share, far = lost / max(lost + len(scores), 1), int((np.abs(scores) > 6.0).sum())
        square = (scores**2).sum() / max(len(scores), 1)
        print(
            f"{kind:13s} accepted {len(scores):5d}, refused {share:6.1%}, variance {square:.3f}, "
            f"beyond six {far}, largest {np.abs(scores).max(initial=0.0):.1f}",
            flush=True,
        )
        for why, count in sorted(refused.items(), key=lambda each: -each[1])[:4]:
            print(f"              {count:4d} {why}")
    scores = np.concatenate(everything)
    print(
        f"{'all':13s} accepted {len(scores):5d}, variance {(scores**2).sum() / max(len(scores), 1):.3f}, beyond six "
        f"{int((np.abs(scores) > 6.0).sum())}"
    )


if __name__ == "__main__":
    main()
