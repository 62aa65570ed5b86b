"""Tracking on one core: one session's update, the tests of its consistency, a whole week."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from track_fixtures import CELL, DRIFT, campaign

from fpcal_bayes.measure import Sweeps
from fpcal_bayes.model import CavityModel
from fpcal_bayes.tracking import (
    Limits,
    SweepMeasurement,
    Track,
    follow_sessions,
    predict,
    smooth,
    take_in,
    track,
    update,
)


@pytest.fixture(scope="module")
def sweeps() -> Sweeps:
    return campaign(0, sessions=24, count=6)[1]


@pytest.fixture(scope="module")
def week(sweeps: Sweeps) -> Track:
    return track(CELL, sweeps)


def test_update_alone(benchmark: Any, sweeps: Sweeps, week: Track) -> None:
    """The iterated update with six sweeps."""
    predicted = predict(DRIFT, week.outcomes[10].state, week.outcomes[11].time_h)
    part = sweeps.of_session("s11")
    measurement = SweepMeasurement.of(DRIFT, CavityModel.of(CELL), part, predicted.mean)
    assert benchmark(update, predicted, measurement).converged


@pytest.mark.parametrize("number", [3, 11, 20])
def test_one_session(benchmark: Any, sweeps: Sweeps, week: Track, number: int) -> None:
    """Prediction, update and tests: the whole of what a session costs."""
    before, part = week.outcomes[number - 1], sweeps.of_session(f"s{number}")
    model = CavityModel.of(CELL)
    found = benchmark(take_in, DRIFT, model, Limits(), before.state, before.monitor, part)
    assert np.isfinite(found.nis)


def test_session_with_a_look_at_16(benchmark: Any, sweeps: Sweeps, week: Track) -> None:
    """The sixteenth session, after which all are linearised again together."""
    parts = [sweeps.of_session(outcome.session) for outcome in week.outcomes[:17]]
    known, model = week.outcomes[:16], CavityModel.of(CELL)
    assert len(benchmark(follow_sessions, week.drift, model, Limits(), known, parts)) == 17


def test_week_of_24_sessions(benchmark: Any, sweeps: Sweeps) -> None:
    assert len(benchmark.pedantic(track, (CELL, sweeps), rounds=3).outcomes) == 25


def test_smoother(benchmark: Any, week: Track) -> None:
    assert len(benchmark(smooth, DRIFT, week.outcomes).states) == 25
