"""The descent: right slopes, within the limits, never worse."""

from dataclasses import replace

import numpy as np
import pytest
from test_planning_design import random_case

from fpcal_bayes.infer.design.candidates import SweepLimits, can_be_followed, candidate_sweeps, controllers
from fpcal_bayes.infer.design.descend import descend
from fpcal_bayes.infer.design.exchange import reference_of
from fpcal_bayes.infer.design.information import Criterion, Design
from fpcal_bayes.infer.design.plan import Planner, PlanSettings
from fpcal_bayes.infer.design.problem import Ground, prior_ground
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell

CELL = load_cell(mechanics="none")
LIMITS = SweepLimits(tilt=np.radians(3.0))


@pytest.fixture(scope="module")
def ground() -> Ground:
    return prior_ground(CELL, draws=6, seed=1)


def planner(ground: Ground, **changes: object) -> Planner:
    small = PlanSettings(n_candidates=60, limits=LIMITS, starts=1, iterations=0, several=True)
    settings = replace(small, **changes)
    return Planner(ground, settings, ground.expected_sd(paper_protocol(CELL), readings=1))


def test_slopes_against_differences() -> None:
    """The criterion's derivative by the rows, along a random direction."""
    case, chosen = random_case(4), (1, 2, 5)
    reference = reference_of(("a", "b"), {"a": 1.0, "b": 2.0})

    def criterion(step: float) -> Criterion:
        return Criterion(Design.of(**(case | {"rows": case["rows"] + step * direction})), reference)

    direction = np.random.default_rng(0).normal(size=case["rows"].shape)
    here = criterion(0.0)
    change = criterion(1.0).design.rows - here.design.rows
    slope = (here.slope(chosen) * change[:, list(chosen)]).sum()
    step = 1e-5
    differences = (criterion(step).value(chosen) - criterion(-step).value(chosen)) / (2 * step)
    assert slope == pytest.approx(differences, rel=1e-4)


@pytest.mark.parametrize("several", [True, False])
def test_descent_is_better_and_keeps_to_the_limits(ground: Ground, several: bool) -> None:
    search = planner(ground, several=several)
    first = search.candidates.take(np.arange(5))
    model, centre, made = CavityModel.of(CELL), CELL.free.nominal, ground.sweep_rows(2, 0.005)
    found = descend(first, search.judge, made, centre, LIMITS, several=several, iterations=25)
    again = descend(first, search.judge, made, centre, LIMITS, several=several, iterations=25)
    np.testing.assert_array_equal(found.q_end, again.q_end)
    assert search.judge(found).value(range(5)) < 0.8 * search.judge(first).value(range(5))
    check_sweeps(found, CELL)
    assert can_be_followed(model, centre, found.q_start, found.q_end, LIMITS).all()
    groups = [set(group.tolist()) for group in controllers(CELL)]
    for before, after in zip(first.q_start != first.q_end, found.q_start != found.q_end, strict=True):
        allowed = [group for group in groups if group & set(np.flatnonzero(before))]
        assert set(np.flatnonzero(after)) <= (allowed[0] if several else set(np.flatnonzero(before)))


def test_a_large_plan_descends_in_parts(ground: Ground, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fpcal_bayes.infer.design.descend._TOGETHER", 2)
    search = planner(ground)
    sweeps = candidate_sweeps(CELL, n=5, rng=np.random.default_rng(2), limits=LIMITS)
    found = descend(sweeps, search.judge, ground.sweep_rows(2, 0.005), CELL.free.nominal, LIMITS, iterations=4)
    assert search.judge(found).value(range(5)) < search.judge(sweeps).value(range(5))
    assert ((found.q_start != sweeps.q_start) | (found.q_end != sweeps.q_end)).any(axis=1).all()


def test_joints_that_cannot_move_stay(ground: Ground) -> None:
    stuck = replace(CELL.joints[0], low=0.0, high=0.0)
    cell: Cell = replace(CELL, joints=(stuck, *CELL.joints[1:]))
    stuck_ground = replace(ground, model=CavityModel.of(cell))
    search = Planner(stuck_ground, PlanSettings(n_candidates=60, limits=LIMITS, starts=1, iterations=5))
    assert not search.best(3).sweeps.q_start[:, 0].any()


def test_no_iterations_leave_the_plan_alone(ground: Ground) -> None:
    search = planner(ground)
    sweeps = search.candidates.take(np.arange(3))
    found = descend(sweeps, search.judge, ground.sweep_rows(2, 0.005), CELL.free.nominal, LIMITS, iterations=0)
    assert found is sweeps
