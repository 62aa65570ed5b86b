"""The simulated cell: its mean, its noise and what is drawn in which order.

Statistical checks allow four standard errors, which a correct program exceeds once in 16,000 (and never with
these seeds).
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import mark_signs, paper_protocol, single_sweep
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import noise_free, simulate_um

CELL = load_cell(mechanics="none")
TRUTH = paper_truth(CELL)
CASE_A = json.loads((Path(__file__).parent / "data" / "case_a.json").read_text())
SIGMA = 0.005


def repeated(sweeps: Sweeps, n: int) -> Sweeps:
    """The same rows n times, each time in groups of their own."""
    parts = []
    for i in range(n):
        group = [f"{name}-{i}" if name else "" for name in sweeps.group.tolist()]
        parts.append(replace(sweeps, group=np.array(group, dtype=np.str_)))
    return join(parts)


def with_repeatability(um: float, deg: float) -> Cell:
    return replace(
        CELL,
        joints=tuple(
            replace(joint, repeatability=um if joint.kind == "prismatic" else np.radians(deg)) for joint in CELL.joints
        ),
    )


def assert_sd(sample, expected):
    n = len(sample)
    assert abs(np.std(sample, ddof=1) / expected - 1.0) < 4.0 / np.sqrt(2.0 * (n - 1))


@pytest.mark.parametrize(
    ("opd", "key"), [("axis", "dl_noise_free_um"), ("perpendicular", "dl_noise_free_perpendicular_um")]
)
def test_without_noise_it_is_the_reference_case(opd, key):
    cell = CELL.with_opd(opd)
    np.testing.assert_allclose(noise_free(cell, TRUTH, paper_protocol(cell)), CASE_A[key], rtol=0, atol=1e-9)


def test_rows_see_the_truth_of_their_time():
    times = np.array([200.0, 12.0, 0.0, 12.0, 192.0])
    plan = join([single_sweep(CELL, 4, -0.05, 0.05)] * len(times))
    plan = replace(plan, time_h=np.array(times, dtype=float))
    model = CavityModel.of(CELL, TRUTH.parameters)
    rows = model.rows(plan.q_start[:1], plan.q_end[:1])
    expected = [model.predict(TRUTH.at(time), rows)[0] for time in times]
    np.testing.assert_allclose(noise_free(CELL, TRUTH, plan), expected, rtol=0, atol=1e-10)
    assert len(set(np.round(expected, 6))) == 3


def test_kinds_of_rows():
    plan = paper_protocol(CELL).take(np.array([0, 0, 0]))
    plan = replace(plan, kind=np.array(["sweep", "path", "absolute"]))
    model = CavityModel.of(CELL, TRUTH.parameters)
    start, end = model.predict(TRUTH.at(0.0), model.pose_rows(np.stack([plan.q_start[0], plan.q_end[0]])))
    np.testing.assert_allclose(noise_free(CELL, TRUTH, plan), [end - start, end - start, end], atol=1e-9)


def test_noise_has_the_sigma_asked_for():
    plan = repeated(paper_protocol(CELL), 60)
    measured = simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=1)
    noise = measured.dl - noise_free(CELL, TRUTH, plan)
    assert_sd(noise, SIGMA)
    assert abs(noise.mean()) < 4.0 * SIGMA / np.sqrt(len(noise))
    assert (measured.sigma == SIGMA).all()
    sigma = np.linspace(0.001, 0.01, len(plan))
    assert_sd((simulate_um(CELL, TRUTH, plan, sigma=sigma, seed=2).dl - noise_free(CELL, TRUTH, plan)) / sigma, 1.0)


def test_rows_of_a_group_share_the_reading_at_their_start():
    plan = repeated(paper_protocol(CELL, midpoints=True), 30)
    noise = simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=3).dl - noise_free(CELL, TRUTH, plan)
    middle, end = noise.reshape(-1, 2).T
    for sample in (middle, end):
        assert_sd(sample, SIGMA)
    # The standard error of a correlation r is (1 - r^2) / sqrt(n).
    assert abs(np.corrcoef(middle, end)[0, 1] - 0.5) < 4.0 * 0.75 / np.sqrt(len(end))
    # Neighbouring groups have nothing in common.
    assert abs(np.corrcoef(end[:-1], middle[1:])[0, 1]) < 4.0 / np.sqrt(len(end))


def test_groups_of_two_sessions_are_two_groups():
    one = paper_protocol(CELL, midpoints=True).take(np.array([0, 1]))
    noise = []
    for seed in range(400):
        plan = join([one, replace(one, session=np.array(["other", "other"]))])
        noise.append(simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=seed).dl - noise_free(CELL, TRUTH, plan))
    correlation = np.corrcoef(np.array(noise).T)
    assert abs(correlation[0, 1] - 0.5) < 4.0 * 0.75 / 20.0
    assert abs(correlation[0, 2]) < 4.0 / 20.0


def test_an_absolute_length_is_one_reading():
    plan = repeated(replace(paper_protocol(CELL).take(np.array([0])), kind=np.array(["absolute"])), 4000)
    assert_sd(simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=4).dl, SIGMA)


def test_repeatability_moves_both_ends():
    cell = with_repeatability(um=0.02, deg=0.0005)
    plan = repeated(paper_protocol(cell).take(np.array([0, 50])), 2000)
    noise = simulate_um(cell, TRUTH, plan, sigma=1e-9, seed=5).dl - noise_free(cell, TRUTH, plan)
    model = CavityModel.of(cell, TRUTH.parameters)
    for row in (0, 1):
        ends = np.stack([plan.q_start[row], plan.q_end[row]])
        # Linear in the joint errors, which are small: each joint at each end adds its own variance.
        slopes = model.joint_jacobian(TRUTH.at(0.0), ends) * cell.repeatability
        assert_sd(noise[row::2], np.sqrt((slopes**2).sum()))


def test_a_group_shares_the_pose_reached_at_its_start():
    cell = with_repeatability(um=0.02, deg=0.0005)
    plan = repeated(paper_protocol(cell, midpoints=True).take(np.array([0, 1])), 3000)
    noise = simulate_um(cell, TRUTH, plan, sigma=1e-9, seed=6).dl - noise_free(cell, TRUTH, plan)
    middle, end = noise.reshape(-1, 2).T
    model = CavityModel.of(cell, TRUTH.parameters)
    poses = np.stack([plan.q_start[0], plan.q_end[0], plan.q_end[1]])
    start_variance, *end_variances = ((model.joint_jacobian(TRUTH.at(0.0), poses) * cell.repeatability) ** 2).sum(1)
    expected = start_variance / np.sqrt(np.prod([start_variance + v for v in end_variances]))
    assert abs(np.corrcoef(middle, end)[0, 1] - expected) < 4.0 * (1.0 - expected**2) / np.sqrt(len(end))
    # What comes back is the pose commanded.
    np.testing.assert_array_equal(simulate_um(cell, TRUTH, plan, sigma=1.0, seed=6).q_end, plan.q_end)


def test_unsigned_rows_give_sizes():
    plan = mark_signs(paper_protocol(CELL), "paper")
    signed = simulate_um(CELL, TRUTH, paper_protocol(CELL), sigma=SIGMA, seed=7)
    unsigned = simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=7)
    np.testing.assert_array_equal(unsigned.dl, np.where(plan.signed, signed.dl, abs(signed.dl)))
    np.testing.assert_array_equal(unsigned.signed, plan.signed)


def test_a_seed_gives_the_same_bytes_and_the_documented_draws():
    plan = paper_protocol(CELL)
    first, again = (simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=8) for _ in range(2))
    assert first.dl.tobytes() == again.dl.tobytes()
    assert (first.dl != simulate_um(CELL, TRUTH, plan, sigma=SIGMA, seed=9).dl).any()
    generator = np.random.default_rng(8)
    generator.standard_normal((2, *plan.q_start.shape))
    start, end = generator.standard_normal((2, len(plan)))
    expected = noise_free(CELL, TRUTH, plan) + SIGMA * (end - start) / np.sqrt(2.0)
    np.testing.assert_allclose(first.dl, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_refuses_a_sigma_that_is_none(sigma):
    with pytest.raises(InputError, match="expected a noise sigma above zero"):
        simulate_um(CELL, TRUTH, paper_protocol(CELL), sigma=sigma, seed=1)


def test_refuses_a_negative_seed_and_unequal_sigmas_in_a_group():
    with pytest.raises(InputError, match="seed -1"):
        simulate_um(CELL, TRUTH, paper_protocol(CELL), sigma=SIGMA, seed=-1)
    plan = paper_protocol(CELL, midpoints=True)
    with pytest.raises(InputError, match="group"):
        simulate_um(CELL, TRUTH, plan, sigma=np.linspace(0.001, 0.01, len(plan)), seed=1)
