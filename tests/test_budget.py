"""Uncertainty budgets: they add up to the task's own standard deviation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fpcal_bayes.core.resources import paper_tables
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.tasks.budget import Budget, Conditions, budget_of
from fpcal_bayes.infer.tasks.error import linear_task_sd, task_jacobian
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.tasks import Task, task_path
from fpcal_bayes.simulator.sweeps import simulate_um

EXACT = Conditions(wavelength_ppm=0.0, temperature_k=0.0, pressure_hpa=0.0)


@pytest.fixture
def stepless(femto: Cell) -> Cell:
    """The built-in cell with joints of no smallest step."""
    return replace(femto, joints=tuple(replace(joint, resolution=0.0) for joint in femto.joints))


def calibrated(cell: Cell, midpoints: bool = False) -> Estimate:
    plan = paper_protocol(cell, midpoints=midpoints)
    return identify(cell, simulate_um(cell, paper_truth(cell), plan, sigma=0.005, seed=0)).estimate


def own_sd(estimate: Estimate, task: Task) -> float:
    jacobian = task_jacobian(CavityModel.of(estimate.cell, estimate.parameters), estimate.values, task)
    return float(linear_task_sd(jacobian, estimate.covariance).max())


def contribution(budget: Budget, start: str) -> float:
    return float(np.sqrt(sum(line.contribution**2 for line in budget.lines if line.name.startswith(start))))


@pytest.mark.parametrize("midpoints", [False, True])
@pytest.mark.parametrize("name", ["circle", "tilt-x"])
def test_inputs_add_up_to_the_tasks_sd(stepless: Cell, name: str, midpoints: bool) -> None:
    estimate = calibrated(stepless, midpoints)
    task = task_path(stepless, estimate.vector(), name)
    budget = budget_of(estimate, task, conditions=EXACT)
    assert budget.combined == pytest.approx(own_sd(estimate, task), rel=1e-6)
    assert_allclose(budget.interval, [-1.96 * budget.combined, 1.96 * budget.combined], rtol=0.02)
    assert_allclose(budget.correlation, budget.correlation.T, atol=1e-12)


def test_repeatability_counts_in_the_task(stepless: Cell) -> None:
    joints = tuple(replace(j, repeatability=1e-3 if j.kind == "prismatic" else 1e-8) for j in stepless.joints)
    cell = replace(stepless, joints=joints)
    estimate = calibrated(cell)
    task = task_path(cell, estimate.vector(), "circle")
    budget = budget_of(estimate, task)
    # The light meets the mirror nearly along q2: its repeatability at both ends is the error in full.
    assert contribution(budget, "repeatability of q2") == pytest.approx(np.sqrt(2) * 1e-3, rel=1e-3)
    exact = budget_of(estimate, task, conditions=EXACT)
    own = contribution(exact, "repeatability")
    assert np.sqrt(exact.combined**2 - own**2) == pytest.approx(own_sd(estimate, task), rel=1e-6)


def test_resolution_of_the_built_in_cell(femto: Cell) -> None:
    """0.5 nm steps of the stage: 0.14 nm, at both ends, along the light."""
    estimate = calibrated(femto)
    budget = budget_of(estimate, task_path(femto, estimate.vector(), "circle"))
    assert contribution(budget, "resolution of q2") == pytest.approx(np.sqrt(2) * 0.5e-3 / np.sqrt(12), rel=1e-3)
    setup = paper_tables()["setup"]
    goniometer, rotary = (1e-6 * setup[f"{name}_resolution_udeg"] for name in ("goniometer", "rotary"))
    stage = 1e-3 * setup["stage_resolution_nm"]
    assert femto.resolution.tolist() == [stage, stage, stage, *np.radians([goniometer, goniometer, rotary])]


def test_joints_of_no_smallest_step_have_no_line(stepless: Cell) -> None:
    estimate = calibrated(stepless)
    budget = budget_of(estimate, task_path(stepless, estimate.vector(), "circle"))
    assert not [line for line in budget.lines if line.name.startswith("resolution")]
    assert budget.combined > 0


def test_index_of_the_air() -> None:
    assert Conditions().index_ppm == pytest.approx(np.hypot(0.93, 2.7))
