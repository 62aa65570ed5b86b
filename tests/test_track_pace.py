"""Drift sizes that are wrong are learnt from the innovations."""

from dataclasses import replace

import numpy as np
import pytest
import track_fixtures
from track_fixtures import CELL, campaign, step_of_beta_4

from fpcal_bayes.analysis.keep import follow_saved
from fpcal_bayes.io.sweeps import write_sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.tracking.filter import predict, update
from fpcal_bayes.tracking.fit_sizes import _log_likelihood, with_learnt_pace
from fpcal_bayes.tracking.measurement import SweepMeasurement
from fpcal_bayes.tracking.session import followed_drift
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.tracker import Track, track


def learnt(sweeps) -> Track:
    def follow(known: Track) -> Track:
        return track(CELL, sweeps, drift=replace(track_fixtures.DRIFT, pace=known.drift.pace), known=known)

    return with_learnt_pace(track(CELL, sweeps), check_sessions(sweeps), follow)


def paced(monkeypatch, factor: float, **arguments):
    """Sweeps of a cell that drifts so many times as fast as stated."""
    with monkeypatch.context() as patch:
        drift = track_fixtures.DRIFT.resized(lambda size: replace(size, walk=factor * size.walk))
        patch.setattr(track_fixtures, "DRIFT", drift)
        return campaign(3, **arguments)[1]


@pytest.mark.parametrize(("factor", "word"), [(3.0, "faster"), (1 / 3, "slower")])
def test_the_pace_is_learnt_and_named(monkeypatch, tmp_path, factor: float, word: str):
    sweeps = paced(monkeypatch, factor, sessions=7)
    found = learnt(sweeps)
    note = found.drift.pace_note
    assert note.startswith(f"drift {word} than stated")
    # Seven sessions of six sweeps tell the pace of mirror and fibre to 12 %, that of the robot to a factor of two.
    robot, mirror = found.drift.pace
    assert mirror == pytest.approx(factor, rel=0.4)
    assert abs(np.log(robot / factor)) < np.log(2.2)
    assert {outcome.verdict for outcome in found.outcomes} == {"as-modelled"}
    later = found.outcomes[1:]
    assert 0.5 < sum(o.nis for o in later) / sum(o.dof for o in later) < 1.6
    assert "drift" in [reason.kind for reason in found.trust.reasons]
    assert found.trust.usable
    if factor > 1:
        # Under the stated sizes the same sessions blame mirror or robot; the command learns the pace and keeps it.
        assert len({outcome.verdict for outcome in track(CELL, sweeps).outcomes}) > 1
        write_sweeps(tmp_path / "c.h5", sweeps, CELL)
        assert follow_saved(tmp_path / "c.h5", CELL).notes == [note]
        again = follow_saved(tmp_path / "c.h5", CELL)
        assert again.notes == [note]
        assert again.track.resumed == 8
        assert again.track.drift.pace == pytest.approx(found.drift.pace)


def test_each_part_has_a_pace_of_its_own():
    """Only mirror and fibre drift faster: the likelihood of both factors is that of filters under each of them."""
    faster = track_fixtures.DRIFT.resized(lambda size: replace(size, walk=3.0 * size.walk))
    model, sweeps = CavityModel.of(CELL), campaign(4, sessions=3)[1]
    found = track(CELL, sweeps)
    parts = check_sessions(sweeps)
    told = _log_likelihood(found, parts, 0, np.array([[1.0, 1.0], [3.0, 3.0]]))
    for pace, drift in zip(told, (track_fixtures.DRIFT, faster), strict=True):
        state, total = found.outcomes[0].state, 0.0
        sized = followed_drift(drift, model, found.outcomes[0])
        for part in parts[1:]:
            state = predict(sized, state, float(part.time_h.max()))
            taken = update(state, SweepMeasurement.of(sized, model, part, state.mean))
            total += taken.innovation.log_likelihood - taken.innovation.log_volume
            total += 0.5 * taken.innovation.dof * np.log(2.0 * np.pi) + np.log(0.95)
            state = taken.state
        # A step in each session was hardly likelier; rows are linearised elsewhere.
        assert pace == pytest.approx(total, abs=1.0)
    assert abs(told[0] - told[1]) > 5.0


def test_stated_sizes_stay_where_they_hold():
    for seed in range(2):
        assert learnt(campaign(seed, sessions=6)[1]).drift.pace == (1.0, 1.0)


def test_a_step_is_no_pace():
    found = learnt(campaign(1, sessions=8, change=step_of_beta_4(), changed=5)[1])
    assert found.drift.pace_note is None
    assert "intrinsics-moved" in [outcome.verdict for outcome in found.outcomes[5:]]
