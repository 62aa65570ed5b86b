"""The order of sweeps: short, and telling the same."""

from itertools import permutations, product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.infer.design.candidates import SweepLimits, candidate_sweeps
from fpcal_bayes.infer.design.order import duration, in_short_order
from fpcal_bayes.infer.design.rows import sweep_rows
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.joint_path import travel_seconds

CELL, LIMITS = load_cell(mechanics="none"), SweepLimits()


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 15))
def test_order_keeps_the_sweeps_and_shortens_the_way(seed: int, n: int) -> None:
    sweeps = candidate_sweeps(CELL, n=n, rng=np.random.default_rng(seed))
    ordered = in_short_order(CELL, sweeps)
    assert sorted(ordered.label) == sorted(sweeps.label)
    where = {label: i for i, label in enumerate(sweeps.label.tolist())}
    for label, start, end in zip(ordered.label.tolist(), ordered.q_start, ordered.q_end, strict=True):
        same = [sweeps.q_start[where[label]], sweeps.q_end[where[label]]]
        assert any(np.array_equal([start, end], pair) for pair in (same, same[::-1]))
    assert duration(CELL, ordered, 2, LIMITS) <= duration(CELL, sweeps, 2, LIMITS) + 1e-9


def test_near_the_shortest_of_all_orders() -> None:
    for seed in range(3):
        sweeps = candidate_sweeps(CELL, n=4, rng=np.random.default_rng(seed))
        ends = np.stack([sweeps.q_start, sweeps.q_end])

        def way(order: tuple[int, ...], turned: tuple[int, ...], ends: np.ndarray = ends) -> float:
            first, last = ends[list(turned), list(order)], ends[1 - np.array(turned), list(order)]
            return float(travel_seconds(CELL, first - np.vstack([np.zeros(6), last[:-1]])).sum())

        shortest = min(way(order, t) for order in permutations(range(4)) for t in product((0, 1), repeat=4))
        ordered = in_short_order(CELL, sweeps)
        before = np.vstack([np.zeros(6), ordered.q_end[:-1]])
        assert travel_seconds(CELL, ordered.q_start - before).sum() <= 1.25 * shortest + 1e-9


def test_a_sweep_tells_the_same_from_either_end() -> None:
    sweeps = candidate_sweeps(CELL, n=5, rng=np.random.default_rng(0))
    ordered = in_short_order(CELL, sweeps)
    model, values = CavityModel.of(CELL), CELL.free.nominal[None]
    for readings in (1, 2, 5):
        a, b = (
            sweep_rows(model, values, plan, readings=readings)[0].reshape(-1, 21) * CELL.free.prior_sd
            for plan in (sweeps, ordered)
        )
        np.testing.assert_allclose(a.T @ a, b.T @ b, atol=1e-6 * np.abs(a.T @ a).max())
