"""Are slipped fringe counts found, and do they leave the estimates alone?

A share of the sweeps of a random truth is off by one or two half wavelengths. The slip likelihood is to flag those
sweeps and no other, its estimates are to be those of the clean data, and the Gaussian fit is to call itself poor.
"""

import argparse
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console

from fpcal_bayes.infer import identify, sample, slip_probabilities, summarise
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Truth, protocol_by_name
from fpcal_bayes.model import Cell
from fpcal_bayes.report import plain_table
from fpcal_bayes.simulator import simulate_um

SIGMA = 0.005


@dataclass(frozen=True)
class Recovery:
    """What became of one truth; shifts and widths are against the posterior of the clean data."""

    least_of_slipped: float
    most_of_others: float
    largest_shift: float
    widest: float
    gaussian_is_called_poor: bool
    converged: bool


def recover(cell: Cell, number: int, *, protocol: str, share: float, draws: int) -> Recovery:
    """One truth from the prior; its random numbers depend on `number` alone."""
    rng = np.random.default_rng(number)
    values = cell.free.nominal + cell.free.prior_sd * rng.standard_normal(len(cell.free))
    truth = Truth(cell.free, np.zeros(1), values[None])
    clean = simulate_um(cell, truth, protocol_by_name(protocol, cell), sigma=SIGMA, seed=number)
    counts = np.zeros(len(clean), dtype=int)
    n_slipped = max(1, round(share * len(clean)))
    counts[rng.choice(len(clean), n_slipped, replace=False)] = rng.choice([-2, -1, 1, 2], n_slipped)
    spoilt = identify(cell, replace(clean, dl=clean.dl + 0.5 * cell.wavelength * counts))
    posterior = sample(spoilt, draws=draws, likelihood="slip", seed=number)
    reference = sample(identify(cell, clean), draws=draws, seed=number)
    of_label = dict(slip_probabilities(posterior) or [])
    shares = np.array([of_label[label] for label in clean.label.tolist()])
    found, expected = summarise(posterior), summarise(reference)
    return Recovery(
        least_of_slipped=float(shares[counts != 0].min()),
        most_of_others=float(shares[counts == 0].max()),
        largest_shift=max(abs(found[name]["mean"] - e["mean"]) / e["sd"] for name, e in expected.items()),
        widest=max(abs(found[name]["sd"] / e["sd"] - 1.0) for name, e in expected.items()),
        gaussian_is_called_poor=any("poor fit" in warning for warning in spoilt.warnings),
        converged=posterior.converged and reference.converged,
    )


def cumulative(cell: Cell, number: int, draws: int) -> str:
    """One sweep with a midpoint slips by up to 4 half waves on either half: right, or said by its own fit."""
    rng = np.random.default_rng([number, 8])
    values = cell.free.nominal + cell.free.prior_sd * rng.standard_normal(len(cell.free))
    truth = Truth(cell.free, np.zeros(1), values[None])
    clean = simulate_um(cell, truth, protocol_by_name("paper-mid", cell), sigma=SIGMA, seed=number)
    counts = np.zeros(len(clean), dtype=int)
    first = 2 * int(rng.integers(len(clean) // 2))
    slips = rng.integers(0, 5, 2) * rng.choice([-1, 1])
    counts[[first, first + 1]] = np.cumsum(slips)
    found = identify(cell, replace(clean, dl=clean.dl + 0.5 * cell.wavelength * counts))
    posterior = sample(found, draws=draws, likelihood="slip", seed=number)
    summary = summarise(posterior)
    shown = cell.free.to_shown(values)
    off = max(abs(e["mean"] - v) / e["sd"] for e, v in zip(summary.values(), shown, strict=True))
    said = "right" if off < 4.5 else "WRONG"
    where = f"{clean.label[first]} {slips}"
    return f"{where}: {said} ({off:.1f} sd), {posterior.trust.verdict}, p = {posterior.predictive_p:.1g}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--protocol", choices=("paper", "paper-mid"), default="paper")
    parser.add_argument("--cumulative", action="store_true", help="slips that add up along one sweep instead")
    parser.add_argument("--share", type=float, default=0.06, help="of the rows that slip (default: 0.06)")
    parser.add_argument("--draws", type=int, default=2000)
    options = parser.parse_args()
    cell, out = load_cell(mechanics="none"), Console(width=120, highlight=False)
    if options.cumulative:
        told = [cumulative(cell, options.first + i, options.draws) for i in range(options.truths)]
        silent = sum("WRONG" in line and "unusable" not in line for line in told)
        out.print("\n".join(told), f"\n{silent} of {len(told)} are both wrong and silent", markup=False)
        return int(silent > 0)
    table = plain_table(
        f"{options.protocol}: {100 * options.share:g} % of the rows slipped",
        ["truth", "least of slipped", "most of others", "largest shift / sd", "widest", "Gaussian called poor"],
    )
    good = []
    for number in range(options.first, options.first + options.truths):
        result = recover(cell, number, protocol=options.protocol, share=options.share, draws=options.draws)
        good.append(
            result.converged
            and result.least_of_slipped > 0.99
            and result.most_of_others < 0.5
            and result.largest_shift < 0.2
            and result.gaussian_is_called_poor
        )
        table.add_row(
            str(number),
            f"{result.least_of_slipped:.4f}",
            f"{result.most_of_others:.2g}",
            f"{result.largest_shift:.3f}",
            f"{100 * result.widest:.0f} %",
            ("yes" if result.gaussian_is_called_poor else "NO") + ("" if result.converged else ", NOT converged"),
        )
    out.print(table)
    out.print(f"In {sum(good)} of {len(good)} truths every slipped row is flagged, no other, and nothing else moves.")
    return 0 if all(good) else 1


if __name__ == "__main__":
    raise SystemExit(main())
