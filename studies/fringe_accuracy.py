"""How well traces are read: errors of dL and L against their stated uncertainty, and the time it takes.

The simulated rig records the paper's protocol again and again, each time with another truth, drawn around that of the
paper, and with another density of samples for every sweep. Printed for sweeps of three fringes and more, and for
shorter ones: the share flagged or refused, the root mean square of the errors, the mean square of the standardised
errors, and how often an unflagged reading is off by a fringe.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np

from fpcal_bayes import ingest
from fpcal_bayes.fringes import Ingested, Reading
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import TraceIndex, Truth, paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Cell
from fpcal_bayes.simulator import RecorderSettings, noise_free, record_sweeps

#: What is worse than an eighth of a wavelength is a wrong count.
WRONG_COUNT = 0.195


def campaigns(options: argparse.Namespace, cell: Cell) -> Iterator[tuple[Truth, TraceIndex]]:
    """Truths and what the rig records of them."""
    plan, paper = paper_protocol(cell), paper_truth(cell)
    sds = np.array([p.prior_sd for p in paper.parameters])
    low, high = np.log(options.samples_per_fringe)
    for seed in range(options.seed, options.seed + options.campaigns):
        random = np.random.default_rng(seed)
        values = paper.at(0.0) + options.spread * sds * random.standard_normal(len(sds))
        truth = Truth(paper.parameters, np.zeros(1), values[None])
        settings = RecorderSettings(
            samples_per_fringe=np.exp(random.uniform(low, high, len(plan))),
            fewest_samples=16,
            velocity_ripple=0.1,
            envelope_change=0.2,
            offset_drift=0.1,
            cyclic_error=0.01,
            noise=0.01,
            fading=not options.no_fading,
        )
        yield truth, record_sweeps(cell, truth, plan, settings, seed=seed, scans=options.scans)


def fringes_passed(cell: Cell, truth: Truth, index: TraceIndex) -> np.ndarray:
    """True fringes of each sweep, those that pass back included, shape (n,)."""
    model, share = CavityModel.of(cell, truth.parameters), np.linspace(0.0, 1.0, 201)
    start, end = index.sweeps.q_start, index.sweeps.q_end
    q = start[:, None] + share[:, None] * (end - start)[:, None]
    lengths = model.predict(truth.at(0.0), model.pose_rows(q.reshape(-1, q.shape[2]))).reshape(len(start), -1)
    return np.abs(np.diff(lengths, axis=1)).sum(axis=1) / (cell.wavelength / 2.0)


def error(reading: Reading, dl: float) -> float:
    """Error of a reading; of its size where its sign is unknown."""
    return reading.dl - dl if reading.signed else abs(reading.dl) - abs(dl)


def scan_scores(cell: Cell, truth: Truth, index: TraceIndex, found: Ingested) -> Iterator[tuple[float, float]]:
    """Errors of absolute lengths and their stated standard deviations."""
    model = CavityModel.of(cell, truth.parameters)
    for q, scans in ((index.sweeps.q_start, found.scans_before), (index.sweeps.q_end, found.scans_after)):
        lengths = model.predict(truth.at(0.0), model.pose_rows(q))
        yield from ((s.length - true, s.sigma) for s, true in zip(scans, lengths, strict=True) if s and s.good)


def print_group(name: str, rows: np.ndarray) -> None:
    """One line for a group of sweeps; columns: fringes, error, sigma, flagged, refused."""
    if len(rows) == 0:
        return
    good = (rows[:, 3] == 0) & (rows[:, 4] == 0)
    errors, scores = rows[good, 1], rows[good, 1] / rows[good, 2]
    lost = f"flagged {rows[:, 3].mean():6.2%}, refused {rows[:, 4].mean():6.2%}"
    if not good.any():
        print(f"{name:22s} {len(rows):5d} sweeps, {lost}")
        return
    print(
        f"{name:22s} {len(rows):5d} sweeps, {lost}, rms {1e3 * np.sqrt(np.mean(errors**2)):6.2f} nm, "
        f"mean square of scores {np.mean(scores**2):.3f}, largest {np.abs(scores).max():.1f}, "
        f"wrong counts {int((np.abs(errors) > WRONG_COUNT).sum())}"
    )


def throughput(cell: Cell, samples: int) -> None:
    """Time to read a campaign of `samples` samples in all."""
    plan = paper_protocol(cell)
    settings = RecorderSettings(duration_s=10.0, rate_hz=samples / len(plan) / 10.0)
    index = record_sweeps(cell, paper_truth(cell), plan, settings, scans=False)
    ingest(index, cell)
    begun, used = time.perf_counter(), time.process_time()
    ingest(index, cell)
    wall, cpu = time.perf_counter() - begun, time.process_time() - used
    total = sum(map(len, index.traces))
    print(f"{total} samples in {len(plan)} traces read in {wall:.2f} s ({cpu:.2f} s of one core)")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=29, help="of 69 sweeps each (default: 29)")
    parser.add_argument("--samples-per-fringe", type=float, nargs=2, default=(4.0, 400.0), metavar=("LOW", "HIGH"))
    parser.add_argument("--spread", type=float, default=0.3, help="of the truths, in standard deviations of the prior")
    parser.add_argument("--no-fading", action="store_true", help="visibility does not follow the mirror's tilt")
    parser.add_argument("--scans", action="store_true", help="wavelength scans too")
    parser.add_argument("--samples", type=int, default=1_000_000, help="of the throughput measurement; 0: none")
    parser.add_argument("--opd", choices=("axis", "perpendicular"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cell = load_cell(opd=options.opd, mechanics="none")
    rows, lengths, used = [], [], 0.0
    for truth, index in campaigns(options, cell):
        begun = time.process_time()
        found = ingest(index, cell)
        used += time.process_time() - begun
        dl, passed = noise_free(cell, truth, index.sweeps), fringes_passed(cell, truth, index)
        for reading, true, fringes in zip(found.readings, dl, passed, strict=True):
            assert reading is not None
            rows.append((fringes, error(reading, true), reading.sigma, bool(reading.doubt), bool(reading.refused)))
        lengths += list(scan_scores(cell, truth, index, found))
    table = np.array(rows, dtype=float)
    print_group("3 fringes and more", table[table[:, 0] >= 3.0])
    print_group("1 to 3 fringes", table[(table[:, 0] >= 1.0) & (table[:, 0] < 3.0)])
    print_group("below 1 fringe", table[table[:, 0] < 1.0])
    if lengths:
        errors, sigmas = np.array(lengths).T
        print(
            f"{len(errors)} absolute lengths: rms {1e3 * np.sqrt(np.mean(errors**2)):.2f} nm, largest "
            f"{1e3 * np.abs(errors).max():.1f} nm, mean square of scores {np.mean((errors / sigmas) ** 2):.3f}"
        )
    print(f"{used / options.campaigns:.2f} s of one core a campaign")
    if options.samples:
        throughput(cell, options.samples)


if __name__ == "__main__":
    main()
