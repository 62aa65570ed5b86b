"""Sweeps made where the tasks are."""

import numpy as np
import pytest
from track_fixtures import CELL

from fpcal_bayes.decision.policy import task_sweeps
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import task_path

MODEL = CavityModel.of(CELL)
TRUTH = paper_truth(CELL).at(0.0)


def test_each_sweep_goes_through_its_pose_with_one_joint():
    poses = task_path(CELL, MODEL.vector(TRUTH), "tilt-x", n_points=3).q
    sweeps = task_sweeps(MODEL, TRUTH, poses)
    check_sweeps(sweeps.with_measurement(np.zeros(len(sweeps)), 0.005), CELL)
    moved = sweeps.q_start != sweeps.q_end
    assert (moved.sum(axis=1) == 1).all()
    resting = np.where(moved, np.nan, sweeps.q_start)
    distance = np.nanmax(np.abs(resting[:, None] - poses), axis=2).min(axis=1)
    assert distance.max() < 1e-9
    # Both translations across the axis can be followed everywhere.
    assert {label: int((sweeps.label == label).sum()) for label in ("q1", "q3")} == {"q1": 3, "q3": 3}


def test_two_translations_at_the_task_tell_all_of_its_circle():
    """Whatever has moved: the error of a circle is what the two sweeps are off by, and nothing else."""
    estimate = TRUTH + np.where([p.unit == "deg" for p in CELL.free], np.radians(0.2), 5.0)
    task = task_path(CELL, MODEL.vector(estimate), "circle", n_points=5)
    sweeps = task_sweeps(MODEL, estimate, task.start[None])
    pair = sweeps.take(np.isin(sweeps.label, ["q1", "q3"]))
    rows = MODEL.rows(pair.q_start, pair.q_end)
    off = dict(zip(pair.label, MODEL.predict(TRUTH, rows) - MODEL.predict(estimate, rows), strict=True))
    circle = MODEL.rows(np.repeat(task.start[None], 5, axis=0), task.q)
    error = MODEL.predict(TRUTH, circle) - MODEL.predict(estimate, circle)
    # Shares of q1 and q3 in the 200 um across the circle, against the 300 um of a sweep.
    for a, b in ((0, 2), (1, 3)):
        moved = (task.q[a] - task.q[b]) / 300.0
        expected = moved[2] * off["q3"] + moved[0] * off["q1"]
        assert error[a] - error[b] == pytest.approx(expected, rel=1e-3, abs=1e-3)
