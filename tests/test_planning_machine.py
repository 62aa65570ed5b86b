"""Plans on a machine with error motions: expectations against the plain formula, slopes, order."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DATA

from fpcal_bayes.infer.design.candidates import candidate_sweeps
from fpcal_bayes.infer.design.information import Criterion
from fpcal_bayes.infer.design.plan import Planner, PlanSettings
from fpcal_bayes.infer.design.problem import Ground, prior_ground
from fpcal_bayes.infer.design.rows import TRACE_READINGS, plan_rows, sweep_rows
from fpcal_bayes.infer.mechanics.rows import row_whitening
from fpcal_bayes.infer.tasks.error import task_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol, read_often
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.mechanics import Terms, design, path_design
from fpcal_bayes.motion.tasks import find_task

TASKS = ("circle", "spin")


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell()


@pytest.fixture(scope="module")
def ground(cell: Cell) -> Ground:
    return prior_ground(cell, tasks=TASKS, draws=3, seed=1)


def test_expected_sd_by_conditioning_a_normal_distribution(cell: Cell, ground: Ground) -> None:
    """All weights kept, the covariance of rows and task written out: none of the design's reductions."""
    assert cell.mechanics is not None
    plan = read_often(paper_protocol(cell), 2)
    plan = replace(plan, sigma=np.full(len(plan), 0.005))
    model, nominal = CavityModel.of(cell), cell.parameters.nominal
    terms = Terms.of(cell, cell.mechanics, cell.free.names)
    made = design(terms, nominal, drive_of_sweeps(plan, cell.mechanics.minutes_per_sweep), plan.sigma)
    unit = row_whitening(model, plan, cell.free.nominal).unwhiten(np.eye(len(plan)))
    shared = made.matrix[:, : made.motion_count]
    values = ground.goals.values[0]
    _, rows = model.predict_with_jacobian(values, model.rows(plan.q_start, plan.q_end, plan.absolute))
    rows = rows * cell.free.prior_sd
    covariance = unit @ unit.T + rows @ rows.T
    found = ground.sd_at_draws(paper_protocol(cell), readings=2)
    for name in TASKS:
        task = find_task(cell, model.vector(values), name, n_points=9)
        task = task.take(task.ok)
        path = path_design(terms, model.vector(values), task.start, task.q)
        jacobian = task_jacobian(model, values, task) * cell.free.prior_sd
        untold = path.unknown_side**2 + path.returned_start**2 + path.returned_point**2
        prior = (jacobian**2).sum(axis=1) + (path.motions**2).sum(axis=1) + untold.sum(axis=1)
        both = jacobian @ rows.T + path.motions @ shared.T
        left = prior - (both * np.linalg.solve(covariance, both.T).T).sum(axis=1)
        assert found[name][0] == pytest.approx(np.sqrt(left.max()), rel=0.05)


@pytest.mark.parametrize("mechanics", [None, "none"])
def test_slopes_of_the_ends_against_differences(ground: Ground, mechanics: str | None) -> None:
    used = ground if mechanics is None else prior_ground(load_cell(mechanics="none"), tasks=TASKS, draws=3, seed=1)
    sweeps = candidate_sweeps(used.cell, n=16, rng=np.random.default_rng(0), several=False)
    made, reference = used.sweep_rows(2, 0.005), np.array([0.05, 0.1])

    def judge(start: np.ndarray, end: np.ndarray):
        design = used.design(replace(sweeps, q_start=start, q_end=end), readings=2, sigma=0.005)
        return Criterion(design, reference)

    by_rows = judge(sweeps.q_start, sweeps.q_end).slope(range(16))[..., : made.root.shape[1]]
    step = 1e-4 * np.where(used.cell.revolute, 0.01, 1.0)
    slope = made.slope(sweeps, by_rows, step)
    moved = sweeps.q_start != sweeps.q_end
    way = np.random.default_rng(1).normal(size=(2, *moved.shape)) * step
    # A joint that stands still is moved at both ends alike.
    way[1] = np.where(moved, way[1], way[0])
    values = [
        judge(sweeps.q_start + sign * way[0], sweeps.q_end + sign * way[1]).value(range(16)) for sign in (1.0, -1.0)
    ]
    # With mechanics the noise of what is new in a sweep also depends on its ends, which the slope leaves out.
    assert (slope * way).sum() == pytest.approx((values[0] - values[1]) / 2, rel=0.1 if mechanics is None else 1e-3)


def test_rows_as_the_protocol_has_them() -> None:
    cell = load_cell(mechanics="none")
    ground, sweeps = prior_ground(cell, tasks=TASKS, draws=2), candidate_sweeps(cell, n=5, rng=np.random.default_rng(0))
    for readings in (1, 2, 5):
        found = ground.sweep_rows(readings, 0.005).of(sweeps)
        rows = sweep_rows(ground.model, ground.goals.values, sweeps, readings=readings) @ ground.root
        a, b = (part.transpose(0, 1, 3, 2) @ part for part in (found, rows))
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9 * np.abs(b).max())


def test_a_whole_trace_tells_as_much_as_many_readings() -> None:
    cell = load_cell(mechanics="none")
    ground, sweeps = prior_ground(cell, tasks=TASKS, draws=4), candidate_sweeps(cell, n=8, rng=np.random.default_rng(0))
    trace = ground.expected_sd(sweeps, readings=0)
    many = ground.expected_sd(sweeps, readings=TRACE_READINGS)
    few = ground.expected_sd(sweeps, readings=2)
    for task, sd in trace.items():
        assert sd == pytest.approx(many[task], rel=0.25)
        assert sd < few[task]


def test_a_plan_on_a_machine_covers_the_spin_and_turns_round(cell: Cell, ground: Ground) -> None:
    """Spin needs q6 where the paper's sweeps do not go; lost motion shows only if joints come from both sides."""
    planner = Planner(ground, PlanSettings(n_candidates=100, starts=1, crossings=1, share=3, iterations=2))
    found = planner.best(8)
    ordered = planner.in_order(found.sweeps)
    assert planner.value(ordered) <= planner.value(found.sweeps) * 1.05
    q6 = np.stack([ordered.q_start, ordered.q_end])[..., 5]
    assert q6.min() < ground.goals.reach[0, 5] + 0.3
    assert q6.max() > ground.goals.reach[1, 5] - 0.3
    assert ((ordered.q_start != ordered.q_end).sum(axis=1) == 1).all()


def test_without_mechanics_rows_in_order_are_those_of_the_plan() -> None:
    cell = load_cell(mechanics="none")
    ground, plan = prior_ground(cell, tasks=TASKS, draws=2), read_often(paper_protocol(cell), 2)
    used = replace(plan, sigma=np.full(len(plan), 0.005))
    whitened = plan_rows(ground.model, ground.goals.values, used) * cell.free.prior_sd
    left = np.linalg.inv(np.eye(21) + whitened.transpose(0, 2, 1) @ whitened)
    for name, sd in ground.sd_at_draws(paper_protocol(cell), readings=2).items():
        jacobian = ground.goals.jacobians[name] * cell.free.prior_sd
        variance = np.einsum("dpi,dij,dpj->dp", jacobian, left, jacobian)
        np.testing.assert_allclose(sd, np.sqrt(variance.max(axis=1)), rtol=1e-4)


def test_a_machine_that_only_misses_what_it_returns_to(femto: Cell) -> None:
    """No error motion is shared between sweep and task, as where a cell states repeatability alone."""
    ground = prior_ground(load_cell(DATA / "lab7.toml"), tasks=TASKS, draws=2)
    assert ground.machine is not None
    assert ground.machine.basis.shape[0] == 0
    before, after = ground.expected_sd(None), ground.expected_sd(paper_protocol(femto).take(np.arange(40)))
    assert all(after[task] < before[task] for task in TASKS)
