"""Information by sweep against differences of log-determinants."""

import numpy as np
import pytest

from fpcal_bayes.infer.observability.information import REDUNDANT_BITS, cumulative_bits, gain_of, information_of
from fpcal_bayes.infer.observability.observe import whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel

CELL = load_cell(mechanics="none")
MODEL = CavityModel.of(CELL)
VALUES = paper_truth(CELL).at(0.0)


def mixed() -> Sweeps:
    """Ten sweeps alone and six with a midpoint, the rows out of order."""
    sweeps = join(
        [paper_protocol(CELL).take(np.arange(30, 40)), paper_protocol(CELL, midpoints=True).take(np.arange(12))]
    )
    sweeps = sweeps.with_measurement(np.zeros(len(sweeps)), 0.005)
    return sweeps.take(np.random.default_rng(3).permutation(len(sweeps)))


def bits(jacobian: np.ndarray) -> float:
    """Half the binary log-determinant of J'J + I, formed from its eigenvalues."""
    return 0.5 * float(np.log2(1.0 + np.linalg.svd(jacobian, compute_uv=False) ** 2).sum())


def test_leverages_sum_to_the_effective_number_of_parameters():
    sweeps = mixed()
    jacobian = whitened_jacobian(MODEL, sweeps, VALUES)
    s = np.linalg.svd(jacobian, compute_uv=False)
    found = information_of(jacobian, sweeps)
    assert found.leverage.sum() == pytest.approx((s**2 / (1 + s**2)).sum(), rel=1e-9)
    assert len(found.labels) == len(found.leverage) == len(found.bits) == 16


def test_bits_of_a_sweep_are_what_is_lost_without_it():
    sweeps = mixed()
    found = information_of(whitened_jacobian(MODEL, sweeps, VALUES), sweeps)
    everything = bits(whitened_jacobian(MODEL, sweeps, VALUES))
    grouped = 0
    for label, lost in zip(found.labels, found.bits, strict=True):
        # A group is left out as a whole; what is left is whitened anew.
        members = np.where(sweeps.group == "", sweeps.label, sweeps.group) == label
        grouped += members.sum() == 2
        left = bits(whitened_jacobian(MODEL, sweeps.take(~members), VALUES))
        assert lost == pytest.approx(everything - left, abs=1e-7)
    assert grouped == 6


def test_a_repeated_sweep_is_redundant_and_a_lone_one_is_not():
    plan = paper_protocol(CELL).take(np.array([0] * 9 + [48]))
    labels = np.array([f"again{i}" for i in range(9)] + ["alone"])
    sweeps = Sweeps.of_um_rad(plan.q_start, plan.q_end, label=labels, sigma=0.005, dl=0.0)
    found = information_of(whitened_jacobian(MODEL, sweeps, VALUES), sweeps)
    assert found.redundant == labels[:9].tolist()
    # Nine equal sweeps with s^2 each far above one: leaving one out loses half log2(9 / 8).
    np.testing.assert_allclose(found.bits[:9], 0.5 * np.log2(9 / 8), atol=1e-4)
    assert found.bits[9] > 5 * REDUNDANT_BITS


def test_the_gain_of_a_candidate_is_what_it_adds():
    plan = paper_protocol(CELL).with_measurement(np.zeros(69), 0.005)
    measured, offered = plan.take(np.arange(0, 69, 2)), plan.take(np.arange(1, 69, 2))
    jacobian = whitened_jacobian(MODEL, measured, VALUES)
    rows = whitened_jacobian(MODEL, offered, VALUES)
    added = [bits(np.vstack([jacobian, row])) - bits(jacobian) for row in rows]
    np.testing.assert_allclose(gain_of(jacobian, rows), added, atol=1e-7)
    assert max(added) > 0.1


def test_the_cumulative_curve_counts_rows():
    plan = paper_protocol(CELL).with_measurement(np.zeros(69), 0.005)
    jacobian = whitened_jacobian(MODEL, plan, VALUES)
    rows, total = cumulative_bits(jacobian)
    assert rows.tolist() == list(range(70))
    np.testing.assert_allclose(total, [bits(jacobian[:n]) for n in range(70)], atol=1e-6)
    assert (np.diff(total) > 0).all()
    many = np.tile(jacobian, (10, 1))
    rows, total = cumulative_bits(many)
    assert len(rows) <= 201
    assert (rows[0], rows[-1]) == (0, 690)
    assert total[-1] == pytest.approx(bits(many), abs=1e-6)
