"""The last session against the last calibration: what changed, and whether the stated drift explains it."""

import numpy as np
import pytest
from track_fixtures import CELL, campaign, knock

from fpcal_bayes.analysis.campaign import CampaignFacts, gather
from fpcal_bayes.analysis.history import since_calibration
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.infer.tasks.error import task_errors
from fpcal_bayes.io.sweeps import write_sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.report.campaign.page import campaign_html
from fpcal_bayes.report.campaign.words import since_content, since_sentence


def followed(folder, **settings) -> CampaignFacts:
    _, sweeps = campaign(**settings)
    write_sweeps(folder / "week.csv", sweeps, CELL)
    return gather(folder / "week.csv", CELL, goal=Goal(50.0))


def test_drift_as_stated_explains_what_changed(tmp_path):
    facts = followed(tmp_path, seed=2, sessions=3)
    found = since_calibration(facts)
    assert found is not None
    assert (found.session, found.hours) == ("day0", 24.0)
    assert found.explained
    assert found.p_value > 1e-3
    # The change is that of the two estimates, and a task is off by what the last says of a path made with the first.
    first, last = facts.track.outcomes[0].state.mean, facts.track.last.state.mean
    drift = facts.track.drift
    change = drift.parameters.to_shown(drift.values(last)) - drift.parameters.to_shown(drift.values(first))
    np.testing.assert_allclose(found.change, change, atol=1e-9)
    assert np.nanmax(np.abs(found.change / found.sd)) < 4.0
    model = CavityModel.of(CELL)
    before, now = drift.values(first), drift.values(last)
    for task in found.tasks:
        path = find_task(CELL, model.vector(before), task.name, n_points=9).within_turns()
        assert task.change == pytest.approx(1e3 * np.ptp(task_errors(model, now, before, path)), rel=0.1, abs=3.0)
    page = campaign_html(facts)
    assert "the stated drift explains it" in page
    assert since_content(found)["tasks"]["circle"]["change_nm"] == found.tasks[0].change


def test_a_knock_is_more_than_drift(tmp_path):
    change = knock(np.random.default_rng(1))
    found = since_calibration(followed(tmp_path, seed=1, sessions=2, change=change, changed=2))
    assert found is not None
    assert not found.explained
    assert "more than the stated drift explains. Calibrate in full" in since_sentence(found)
    circle = found.tasks[0]
    assert circle.change > circle.most > circle.expected


def test_one_session_has_nothing_to_compare(tmp_path):
    facts = followed(tmp_path, seed=1, sessions=0)
    assert since_calibration(facts) is None
    assert since_content(None) is None
    assert "no two sessions" in campaign_html(facts)
