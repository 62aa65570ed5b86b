"""Task errors and budgets as tables and JSON: the numbers are those of the results."""

import json

import numpy as np
import pytest
from task_fixtures import paper_estimate

from fpcal_bayes.infer.tasks.budget import budget_of
from fpcal_bayes.infer.tasks.prediction import TaskPrediction, predict_from_covariance
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.report.tasks import (
    budget_content,
    budget_table,
    correlation_lines,
    prediction_content,
    prediction_table,
    reach_warnings,
)


@pytest.fixture
def prediction(femto: Cell) -> TaskPrediction:
    estimate = paper_estimate(femto)
    return predict_from_covariance(estimate, task_path(femto, estimate.vector(), "circle", n_points=9), draws=500)


def test_prediction(prediction: TaskPrediction) -> None:
    content = prediction_content(prediction, 0.002, prediction.task)
    json.dumps(content, allow_nan=False)
    assert content["worst_sd_nm"] == pytest.approx(1e3 * prediction.sd.max())
    assert content["exceeds_probability"] == prediction.exceeds(0.002)
    assert content["peak_to_peak_nm"]["median"] == pytest.approx(1e3 * np.median(prediction.peak_to_peak))
    assert "tolerance_nm" not in prediction_content(prediction, None, prediction.task)
    text = str(prediction_table([prediction], [0.002], "errors"))
    assert "circle" in text
    assert "P(> 2 nm)" in text
    assert f"{content['worst_sd_nm']:.2f}" in text
    assert reach_warnings(prediction.task) == []


def test_lines_that_saturate(femto: Cell) -> None:
    estimate = paper_estimate(femto)
    task = task_path(femto, estimate.vector(), "line-x", n_points=7)
    (sentence,) = reach_warnings(task)
    assert sentence.startswith("task line-x: 1 of 7 points cannot be driven to; point 7: saturated: q3")
    driven = predict_from_covariance(estimate, task.driven(), draws=500)
    content = prediction_content(driven, None, task)
    json.dumps(content, allow_nan=False)
    assert (content["points"], content["points_not_ok"]) == (7, 1)
    assert content["sd_nm"] == [*(1e3 * driven.sd), None]
    assert content["band_nm"]["low"][-1] is None


def test_budget(femto: Cell) -> None:
    estimate = paper_estimate(femto)
    budget = budget_of(estimate, task_path(femto, estimate.vector(), "tilt-x"))
    content = budget_content(budget)
    json.dumps(content, allow_nan=False)
    squares = np.array([entry["contribution_nm"] for entry in content["inputs"]])
    combined = np.sqrt(squares @ np.array(content["correlation"]) @ squares)
    assert content["combined_nm"] == pytest.approx(combined)
    text = str(budget_table(budget))
    assert "robot lengths" in text
    assert f"{content['combined_nm']:.3g}" in text
    lines = correlation_lines(budget)
    assert any(line.startswith("correlation of robot lengths with fibre in the world: ") for line in lines)
