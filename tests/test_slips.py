"""Slipped fringe counts are found and corrected."""

from dataclasses import replace

import numpy as np
import pytest

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.slips import find_slips
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate_um


def slipped_sweeps(cell: Cell, seed: int, n_slips: int) -> tuple[Sweeps, Sweeps, np.ndarray]:
    """Clean and slipped sweeps of a random cell, and by how many half wavelengths each row slipped."""
    rng = np.random.default_rng(seed)
    values = cell.free.nominal + cell.free.prior_sd * rng.standard_normal(len(cell.free))
    truth = Truth(cell.free, np.zeros(1), values[None])
    clean = simulate_um(cell, truth, paper_protocol(cell), sigma=0.005, seed=seed)
    counts = np.zeros(len(clean), dtype=int)
    counts[rng.choice(len(clean), n_slips, replace=False)] = rng.choice([-2, -1, 1, 2], n_slips)
    return clean, replace(clean, dl=clean.dl + 0.5 * cell.wavelength * counts), counts


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_every_slip_is_found_and_no_other(femto: Cell, opd: str) -> None:
    cell = femto.with_opd(opd)  # type: ignore[arg-type]
    for seed in range(12):
        clean, slipped, counts = slipped_sweeps(cell, seed, n_slips=4)
        result = identify(cell, slipped)
        slips = find_slips(result.problem, result.solution)
        assert slips.counts.tolist() == counts.tolist(), seed
        np.testing.assert_allclose(slips.problem.target, clean.dl, atol=1e-12)
        # The Gaussian fit of the same data says itself that something is wrong.
        assert any("poor fit" in warning for warning in result.warnings)


def test_clean_sweeps_are_left_alone(femto: Cell) -> None:
    for seed in range(10):
        clean, _, _ = slipped_sweeps(femto, seed, n_slips=0)
        result = identify(femto, clean)
        slips = find_slips(result.problem, result.solution)
        assert not slips.counts.any()
        assert slips.solution is result.solution
