"""Simulated weeks of `studies/`: what drifts in them, and what a rule does to them."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def weeks(monkeypatch):
    """The module of the weeks, and that of the rules."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "studies"))
    import drifting_week
    import policies

    return drifting_week, policies


def test_measuring_more_often_takes_more_sweeps(weeks, femto):
    drifting, policies = weeks
    setting = drifting.Setting(femto, hours=3.0)
    week, two = drifting.simulate_week(setting, 0), policies.translations(6, 3, 1)
    runs = [
        drifting.follow(setting, week, rule, ("circle",))
        for rule in (policies.never(setting), policies.fixed(1.0, two))
    ]
    assert [sum(run.sweeps) for run in runs] == [0, 4]
    assert [len(run.times) for run in runs] == [0, 2]
    assert runs[0].errors.shape == (1, 31)
    # Until the first session both hold the same estimate.
    np.testing.assert_array_equal(runs[0].errors[:, :10], runs[1].errors[:, :10])
    assert (runs[0].errors[:, 20:] != runs[1].errors[:, 20:]).all()


def test_the_truth_walks_as_the_drift_model_says(weeks, femto):
    setting = weeks[0].Setting(femto, hours=48.0)
    week = weeks[0].simulate_week(setting, 5)
    steps = np.diff(week.values, axis=0)
    drifting = setting.drift.walk > 0
    rate = np.sqrt((steps[:, drifting] ** 2).sum(axis=0) / 2.0) / (setting.drift.walk * setting.drift.scale)[drifting]
    # 480 steps: a standard error of 3 %.
    np.testing.assert_allclose(rate, 1.0, atol=0.13)
    assert (steps[:, ~drifting] == 0).all()
