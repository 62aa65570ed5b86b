"""Planning: better than random and than the greedy start, the same by seed, honest about what it promises."""

from dataclasses import replace

import numpy as np
import pytest
from task_fixtures import paper_estimate

import fpcal_bayes as fp
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.candidates import candidate_sweeps
from fpcal_bayes.infer.design.exchange import ChosenSweeps, choose_sweeps, chosen_sweeps, reference_of
from fpcal_bayes.infer.design.order import duration
from fpcal_bayes.infer.design.plan import Planner, PlanSettings
from fpcal_bayes.infer.design.problem import (
    DEFAULT_TASKS,
    Ground,
    estimate_ground,
    goals_of,
    measured_ground,
    prior_ground,
    shortfalls,
)
from fpcal_bayes.infer.design.rows import sweep_rows
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.tasks.error import linear_task_sd, task_errors, task_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol, read_often
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.simulator.sweeps import simulate_um

SMALL = PlanSettings(n_candidates=150, starts=2, crossings=2, iterations=10, share=4, several=True)


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell(mechanics="none")


@pytest.fixture(scope="module")
def ground(cell: Cell) -> Ground:
    return prior_ground(cell, draws=8, seed=1)


@pytest.fixture(scope="module")
def planner(cell: Cell, ground: Ground) -> Planner:
    return Planner(ground, SMALL, ground.expected_sd(paper_protocol(cell), readings=1))


def test_paper_protocol_as_the_tasks_know_it(cell: Cell) -> None:
    """Expected standard deviations at one point are those of the Laplace covariance, worst point of the path."""
    known = paper_estimate(cell)
    prior = Estimate(cell, cell.free, known.values, np.diag(cell.free.prior_sd**2), known.status)
    expected = estimate_ground(prior, points=61).expected_sd(paper_protocol(cell), readings=1)
    model = CavityModel.of(cell)
    for name, sd in expected.items():
        task = task_path(cell, known.vector(), name)
        task = task.take(task.ok)
        assert sd == pytest.approx(
            linear_task_sd(task_jacobian(model, known.values, task), known.covariance).max(), rel=1e-4
        )


def test_better_than_random_and_than_greedy(cell: Cell, ground: Ground, planner: Planner) -> None:
    found = planner.best(8)
    plain = Planner(
        ground,
        replace(SMALL, iterations=0, starts=1),
        dict(zip(ground.goals.jacobians, planner.reference, strict=True)),
    )
    excess = planner.excess({name: sd[-1] for name, sd in found.sd.items()})
    random = candidate_sweeps(cell, n=8, rng=np.random.default_rng(3))
    assert excess < planner.excess({name: sd[-1] for name, sd in plain.best(8).sd.items()})
    assert excess < 0.5 * planner.excess(ground.expected_sd(random))
    for sd in found.sd.values():
        assert len(sd) == 9
        assert (np.diff(sd) <= 1e-12).all()
    again = Planner(ground, SMALL, dict(zip(ground.goals.jacobians, planner.reference, strict=True))).best(8)
    np.testing.assert_array_equal(found.sweeps.q_start, again.sweeps.q_start)


@pytest.mark.parametrize("n", [3, 6])
def test_no_worse_than_single_joints(ground: Ground, planner: Planner, n: int) -> None:
    """Where joints may move together the plan of single joints is a candidate, on the draws planned for."""
    single, found = planner.single(n), planner.best(n)
    assert (np.count_nonzero(single.sweeps.q_start != single.sweeps.q_end, axis=1) == 1).all()
    assert planner.excess(ground.expected_sd(found.sweeps)) <= planner.excess(ground.expected_sd(single.sweeps))
    # A search that finds nothing good when joints move together gives the other plan.
    lame = Planner(ground, replace(SMALL, iterations=0, starts=1), {"circle": 0.05})
    lame._singles[n] = single
    given = lame.best(n)
    assert lame.excess(ground.expected_sd(given.sweeps)) <= lame.excess(ground.expected_sd(single.sweeps))


def test_fewest_is_enough_and_says_what_cannot_be(ground: Ground) -> None:
    planner = Planner(ground, SMALL, {"circle": 0.05})
    found = planner.fewest(most=20)
    assert found.sd["circle"][-1] <= 0.05
    with pytest.raises(InputError, match=r"no plan of up to 3 sweeps reaches the target; the best has circle .* nm"):
        Planner(ground, SMALL, {"circle": 1e-6}).fewest(most=3)


def test_candidates_that_suffice_are_a_plan_though_the_descent_leads_away(
    ground: Ground, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = Planner(ground, SMALL, {"circle": 0.05})
    still = candidate_sweeps(ground.cell, n=1, rng=np.random.default_rng(0))
    still = replace(still, q_end=still.q_start)

    def lost(sweeps: Sweeps, *_: object) -> ChosenSweeps:
        useless = still.take(np.zeros(len(sweeps), dtype=np.int64))
        return chosen_sweeps(planner.judge(useless).design, useless, tuple(range(len(sweeps))))

    monkeypatch.setattr(planner, "refined", lost)
    monkeypatch.setattr(planner, "best", lambda n: lost(planner.candidates.take(np.arange(n))))
    monkeypatch.setattr(planner, "single", lambda n: lost(planner.candidates.take(np.arange(n))))
    found = planner.fewest(most=20, settle=True)
    assert planner.excess(planner.left(found.sweeps)) <= 1.0
    assert len(found) < 20
    # Where nothing suffices as many as are asked for come back.
    hopeless = Planner(ground, SMALL, {"circle": 1e-6})
    assert len(hopeless.fewest(most=3, settle=True)) == 3


def test_a_plan_within_a_time_gives_up_its_least_useful_sweeps(cell: Cell, planner: Planner) -> None:
    def minutes(sweeps: Sweeps) -> float:
        return duration(cell, planner.in_order(sweeps), SMALL.readings, SMALL.limits) / 60.0

    whole = planner.best(6)
    limit = 0.98 * minutes(whole.sweeps)
    fitting = max((k for k in range(1, 6) if minutes(whole.first(k).sweeps) <= limit), default=0)
    found = planner.within(60.0 * limit, most=6)
    assert minutes(found.sweeps) <= limit
    assert fitting <= len(found) < 6
    assert {task: len(sd) for task, sd in found.sd.items()} == dict.fromkeys(whole.sd, len(found) + 1)


def test_expected_sd_is_what_simulated_calibrations_have(cell: Cell) -> None:
    """Errors on the circle of simulated re-identifications, against the figure that the plan promises."""
    model, known = CavityModel.of(cell), paper_estimate(cell, midpoints=True)
    moved = np.array([p.kind == "extrinsic" for p in cell.free]) * 0.02 * cell.free.prior_sd
    known = replace(known, covariance=known.covariance + np.diag(moved**2))
    plan = Planner(estimate_ground(known, tasks=("circle",)), SMALL).best(4)
    sweeps, random = read_often(plan.sweeps, 2), np.random.default_rng(0)
    squares = []
    for seed in range(30):
        values = random.multivariate_normal(known.values, known.covariance)
        measured = simulate_um(cell, Truth(cell.free, np.zeros(1), values[None]), sweeps, sigma=0.005, seed=seed)
        estimate = identify(cell, measured, start=known, prior=known).estimate
        task = task_path(cell, estimate.vector(), "circle", n_points=9)
        squares.append(task_errors(model, values[None], estimate.values, task)[0] ** 2)
    rms = np.sqrt(np.mean(squares, axis=0).max())
    # 30 truths tell a standard deviation to 13 %; the worst of nine points is a little high.
    assert rms == pytest.approx(plan.sd["circle"][-1], rel=0.35)
    assert rms < 0.1 * plan.sd["circle"][0]


def test_choice_with_a_covariance_in_other_units(cell: Cell, ground: Ground) -> None:
    """The same choice whether derivatives are by um and rad or by prior units."""
    sweeps = candidate_sweeps(cell, n=60, rng=np.random.default_rng(0))
    rows, scale = sweep_rows(ground.model, ground.goals.values[:1], sweeps), cell.free.prior_sd
    tasks = {name: jacobian[:1] for name, jacobian in ground.goals.jacobians.items()}
    first = choose_sweeps(rows, tasks, 3, np.diag(scale**2))
    again = choose_sweeps(
        rows * scale, {name: jacobian * scale for name, jacobian in tasks.items()}, 3, np.eye(len(scale))
    )
    assert first == again


def test_what_few_sweeps_leave_undetermined(cell: Cell, ground: Ground) -> None:
    few = candidate_sweeps(cell, n=1, rng=np.random.default_rng(0))
    sentences = shortfalls(ground, few)
    assert any("1 sweep leaves task tilt-x undetermined" in sentence for sentence in sentences)
    assert shortfalls(ground, paper_protocol(cell)) == []
    # A day's drift that a sweep tells nothing of is left undetermined; what measured sweeps have told is not.
    known = paper_estimate(cell)
    moved = np.array([p.kind == "extrinsic" for p in cell.free]) * 0.02 * cell.free.prior_sd
    later = estimate_ground(replace(known, covariance=known.covariance + np.diag(moved**2)))
    still = replace(few, q_end=few.q_start)
    assert [" undetermined: " in s for s in shortfalls(later, still)] == [True] * len(DEFAULT_TASKS)
    assert shortfalls(replace(later, measured=True), still) == []
    measured = measured_ground(
        known, simulate_um(cell, paper_truth(cell), paper_protocol(cell), sigma=0.005, seed=0), draws=2
    )
    assert shortfalls(measured, still) == []


def test_numbers_of_numpy(cell: Cell) -> None:
    """A small integer of numpy plans as Python's own, and a task that is named twice counts once."""
    one, other = fp.plan(cell, np.int8(2), draws=np.int64(2), seed=np.uint8(1)), fp.plan(cell, 2, draws=2, seed=1)
    np.testing.assert_array_equal(one.q_end, other.q_end)
    assert len(fp.plan(cell, 1, draws=2, tasks=("circle", "circle"))) == 1


def test_bad_arguments(cell: Cell, ground: Ground, planner: Planner) -> None:
    sweeps = candidate_sweeps(cell, n=5, rng=np.random.default_rng(0))
    rows, tasks = sweep_rows(ground.model, ground.goals.values, sweeps), ground.goals.jacobians
    with pytest.raises(InputError, match="6 sweeps out of 5 candidates"):
        choose_sweeps(rows, tasks, 6, np.eye(rows.shape[-1]))
    with pytest.raises(InputError, match="no task to plan for"):
        goals_of(ground.model, ground.goals.values, [])
    with pytest.raises(InputError, match="tolerance of an unknown task 'square'"):
        reference_of(tuple(tasks), {"square": 1.0})
    with pytest.raises(InputError, match="expected numbers above zero"):
        reference_of(tuple(tasks), {"circle": 0.0})
    with pytest.raises(InputError, match="0 sweeps out of 150"):
        planner.best(0)
    for n in (2.0, True, "4", None, float("nan"), [3]):
        with pytest.raises(InputError, match=r"plan: n is of type \w+, expected a whole number"):
            fp.plan(cell, n)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="-1 readings of a sweep"):
        fp.plan(cell, 2, readings=-1)
    for sigma in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="nm of a reading: expected a number above zero"):
            fp.plan(cell, 2, sigma_nm=sigma)
    with pytest.raises(InputError, match="-1 draws of what is known: expected one at least"):
        fp.plan(cell, 2, draws=-1)
    with pytest.raises(InputError, match="plan: seed -1: expected zero or more"):
        fp.plan(cell, 2, seed=-1)
    with pytest.raises(InputError, match="plan: tasks is of type str, expected a list of names"):
        fp.plan(cell, 2, tasks="circle")
    with pytest.raises(InputError, match="unknown task 'square'"):
        goals_of(ground.model, ground.goals.values, ["square"])
