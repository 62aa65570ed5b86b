"""Uncertainty budgets: they add up to the task's own standard deviation, by either division into inputs."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from task_fixtures import paper_values

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import paper_tables
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.tasks.budget import Budget, Conditions, budget_of
from fpcal_bayes.infer.tasks.error import linear_task_sd, task_errors, task_jacobian
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.tasks import Task, task_path
from fpcal_bayes.simulator.sweeps import noise_free, simulate_um

EXACT = Conditions(wavelength_ppm=0.0, temperature_k=0.0, pressure_hpa=0.0)


@pytest.fixture
def stepless(femto: Cell) -> Cell:
    """The built-in cell with joints of no smallest step."""
    return replace(femto, joints=tuple(replace(joint, resolution=0.0) for joint in femto.joints))


def calibrated(cell: Cell, midpoints: bool = False) -> tuple[Estimate, Sweeps]:
    plan = paper_protocol(cell, midpoints=midpoints)
    sweeps = simulate_um(cell, paper_truth(cell), plan, sigma=0.005, seed=0)
    return identify(cell, sweeps).estimate, sweeps


def own_sd(estimate: Estimate, task: Task) -> float:
    jacobian = task_jacobian(CavityModel.of(estimate.cell, estimate.parameters), estimate.values, task)
    return float(linear_task_sd(jacobian, estimate.covariance).max())


def contribution(budget: Budget, start: str) -> float:
    return float(np.sqrt(sum(line.contribution**2 for line in budget.lines if line.name.startswith(start))))


@pytest.mark.parametrize("midpoints", [False, True])
@pytest.mark.parametrize("name", ["circle", "tilt-x"])
def test_inputs_add_up_to_the_tasks_sd(stepless: Cell, name: str, midpoints: bool) -> None:
    estimate, sweeps = calibrated(stepless, midpoints)
    task = task_path(stepless, estimate.vector(), name)
    for known in (None, sweeps):
        budget = budget_of(estimate, task, sweeps=known, conditions=EXACT)
        assert budget.combined == pytest.approx(own_sd(estimate, task), rel=1e-6)
        assert_allclose(budget.interval, [-1.96 * budget.combined, 1.96 * budget.combined], rtol=0.02)
        assert_allclose(budget.correlation, budget.correlation.T, atol=1e-12)


@pytest.mark.usefixtures("minima_only")
def test_fringe_noise_is_what_noise_does(femto: Cell) -> None:
    """The noise line against the spread of estimates from repeated measurements of one truth."""
    estimate, sweeps = calibrated(femto, midpoints=True)
    task = task_path(femto, estimate.vector(), "tilt-z")
    budget = budget_of(estimate, task, sweeps=sweeps, conditions=EXACT)
    model, values = CavityModel.of(femto), paper_values(femto)
    truth = paper_truth(femto)
    errors = []
    for seed in range(40):
        repeated = simulate_um(femto, truth, sweeps, sigma=0.005, seed=100 + seed)
        found = identify(femto, repeated).estimate.values
        errors.append(task_errors(model, found, values, task)[0])
    worst = int(np.argmin(np.abs(task.along - budget.along)))
    assert np.std(np.array(errors)[:, worst]) == pytest.approx(contribution(budget, "fringe noise"), rel=0.35)


def test_wavelength_scales_readings(femto: Cell) -> None:
    """Sweeps read with a wrong wavelength move the minimum by the sensitivity in the budget."""
    plan, model = paper_protocol(femto), CavityModel.of(femto)
    # Without noise: residuals times curvature are no part of a budget to first order.
    exact = plan.with_measurement(noise_free(femto, paper_truth(femto), plan), np.full(len(plan), 0.005))

    def minimum(sweeps: Sweeps, start: np.ndarray) -> np.ndarray:
        problem = Problem.of(model, sweeps)
        unknowns = problem.unknowns(start)
        for _ in range(30):
            unknowns = unknowns - np.linalg.lstsq(problem.jacobian(unknowns), problem.residuals(unknowns))[0]
        return problem.values(unknowns)

    values = minimum(exact, identify(femto, exact).estimate.values)
    estimate = replace(identify(femto, exact).estimate, values=values)
    task = task_path(femto, estimate.vector(), "tilt-x")
    budget = budget_of(estimate, task, sweeps=exact)
    sensitivity = next(line.sensitivity for line in budget.lines if line.name == "laser wavelength")
    ppm = 10.0
    moved = minimum(exact.with_measurement(exact.dl * (1 + 1e-6 * ppm), exact.sigma), values)
    change = task_errors(model, moved, values, task)[0]
    worst = int(np.argmin(np.abs(task.along - budget.along)))
    assert change[worst] == pytest.approx(ppm * sensitivity, rel=0.05)


def test_repeatability_counts_in_calibration_and_task(stepless: Cell) -> None:
    joints = tuple(replace(j, repeatability=1e-3 if j.kind == "prismatic" else 1e-8) for j in stepless.joints)
    cell = replace(stepless, joints=joints)
    estimate, sweeps = calibrated(cell)
    task = task_path(cell, estimate.vector(), "circle")
    budget = budget_of(estimate, task, sweeps=sweeps)
    assert contribution(budget, "joint repeatability, calibration") > 0
    # The light meets the mirror nearly along q2: its repeatability at both ends is the error in full.
    assert contribution(budget, "repeatability of q2") == pytest.approx(np.sqrt(2) * 1e-3, rel=1e-3)
    exact = budget_of(estimate, task, sweeps=sweeps, conditions=EXACT)
    own = contribution(exact, "repeatability")
    assert np.sqrt(exact.combined**2 - own**2) == pytest.approx(own_sd(estimate, task), rel=1e-6)


def test_resolution_of_the_built_in_cell(femto: Cell) -> None:
    """0.5 nm steps of the stage: 0.14 nm, at both ends, along the light."""
    estimate, _ = calibrated(femto)
    budget = budget_of(estimate, task_path(femto, estimate.vector(), "circle"))
    assert contribution(budget, "resolution of q2") == pytest.approx(np.sqrt(2) * 0.5e-3 / np.sqrt(12), rel=1e-3)
    setup = paper_tables()["setup"]
    goniometer, rotary = (1e-6 * setup[f"{name}_resolution_udeg"] for name in ("goniometer", "rotary"))
    stage = 1e-3 * setup["stage_resolution_nm"]
    assert femto.resolution.tolist() == [stage, stage, stage, *np.radians([goniometer, goniometer, rotary])]


def test_joints_of_no_smallest_step_have_no_line(stepless: Cell) -> None:
    estimate, _ = calibrated(stepless)
    budget = budget_of(estimate, task_path(stepless, estimate.vector(), "circle"))
    assert not [line for line in budget.lines if line.name.startswith("resolution")]
    assert budget.combined > 0


def test_index_of_the_air() -> None:
    assert Conditions().index_ppm == pytest.approx(np.hypot(0.93, 2.7))


def test_plans_are_refused(femto: Cell) -> None:
    estimate, _ = calibrated(femto)
    task = task_path(femto, estimate.vector(), "circle")
    with pytest.raises(InputError, match="expected sweeps with dl_um and sigma_um"):
        budget_of(estimate, task, sweeps=paper_protocol(femto))
