"""Drift sizes that are wrong are learnt from the innovations."""

from dataclasses import replace

import numpy as np
import pytest
import track_fixtures
from track_fixtures import CELL, campaign, step_of_beta_4

from fpcal_bayes.analysis.campaign import follow
from fpcal_bayes.io.sweeps import write_sweeps
from fpcal_bayes.tracking.fit_sizes import with_learnt_scale
from fpcal_bayes.tracking.tracker import Track, track


def learnt(sweeps) -> Track:
    return with_learnt_scale(track(CELL, sweeps), lambda sized, first: track(CELL, sweeps, drift=sized, known=first))


@pytest.mark.parametrize(("factor", "word"), [(3.0, "faster"), (1 / 3, "slower")])
def test_the_pace_is_learnt_and_named(monkeypatch, tmp_path, factor: float, word: str):
    drift = track_fixtures.DRIFT.resized(lambda size: replace(size, walk=factor * size.walk))
    stated = track_fixtures.DRIFT
    monkeypatch.setattr(track_fixtures, "DRIFT", drift)
    _, sweeps = campaign(3, sessions=7)
    found = learnt(sweeps)
    assert found.pace.startswith(f"drift {word} than stated")
    scales = [new.walk / old.walk for new, old in zip(found.drift.sizes, stated.sizes, strict=True) if old.walk]
    # Seven sessions of six sweeps tell the pace of mirror and fibre to 12 %, that of the robot to a factor of two.
    np.testing.assert_allclose(scales[-8:], factor, rtol=0.5)
    assert np.abs(np.log(np.array(scales[:4]) / factor)).max() < np.log(2.0)
    assert {outcome.verdict for outcome in found.outcomes} == {"as-modelled"}
    later = found.outcomes[1:]
    assert 0.5 < sum(o.nis for o in later) / sum(o.dof for o in later) < 1.6
    assert "drift" in [reason.kind for reason in found.trust.reasons]
    assert found.trust.usable
    if factor > 1:
        # Under the stated sizes the same sessions blame mirror or robot; the command learns the pace.
        assert len({outcome.verdict for outcome in found.stated.outcomes}) > 1
        write_sweeps(tmp_path / "c.h5", sweeps, CELL)
        assert follow(tmp_path / "c.h5", CELL).notes == [found.pace]


def test_stated_sizes_stay_where_they_hold():
    for seed in range(2):
        sweeps = campaign(seed, sessions=6)[1]
        assert learnt(sweeps).stated is None


def test_a_step_is_no_pace():
    found = learnt(campaign(1, sessions=8, change=step_of_beta_4(), changed=5)[1])
    assert found.pace is None
    assert "intrinsics-moved" in [outcome.verdict for outcome in found.outcomes[5:]]
