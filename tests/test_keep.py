"""The loop: decide, measure, append, again; whatever is in the way, no ticket is stale, lost or measured twice."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from fpcal_bayes.analysis.append import append
from fpcal_bayes.analysis.keep import Keeper, Outputs
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps, write_sweeps
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
TRUTH = paper_truth(CELL)


class Lab:
    """A campaign, a clock that a test moves, and a person who measures what tickets ask for."""

    def __init__(self, folder: Path, suffix: str = ".h5") -> None:
        self.now, self.campaign = 1.8e9, folder / f"campaign{suffix}"
        self.outputs = Outputs(folder / "now.json", folder / "ticket.csv", folder / "now.mat")
        sweeps = simulate_um(CELL, TRUTH, paper_protocol(CELL), sigma=0.005, seed=1)
        write_sweeps(self.campaign, sweeps, CELL)

    def keeper(self) -> Keeper:
        goal, costs = Goal(50.0), Costs(sigma_nm=5.0, diagnosis_h=24.0)
        return Keeper(self.campaign, CELL, goal, lambda _: costs, self.outputs, lambda: self.now)

    def measure(self, seed: int = 1) -> str:
        plan = read_sweeps(self.outputs.ticket, CELL, plan=True)
        session = self.campaign.with_name(f"{plan.session[0]}.csv")
        write_sweeps(session, simulate_um(CELL, TRUTH, plan, sigma=0.005, seed=seed), CELL)
        append(self.campaign, session, CELL, ticket=self.outputs.ticket)
        return str(plan.session[0])


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
def test_days_without_clock_times(tmp_path, suffix):
    lab, measured = Lab(tmp_path, suffix), []
    for _ in range(8):
        found = lab.keeper().round()
        assert found.now_h == pytest.approx((lab.now - 1.8e9) / 3600.0, abs=1e-6)
        ticket = read_ticket(lab.outputs.ticket, CELL)
        if ticket.plan is not None:
            assert ticket.expires_utc == pytest.approx(lab.now + 4 * 3600.0, abs=1e-3)
            measured.append(lab.measure())
            assert read_ticket(lab.outputs.ticket, CELL).plan is None
        lab.now += 1800.0
    assert len(measured) >= 2
    lab.keeper().round()
    assert read_sweeps(lab.campaign, CELL).sessions == ("full-T0", *measured)
    said = json.loads(lab.outputs.estimate.read_text())
    assert {"verdict", "calibration_due", "warnings", "trust", "valid_until_h"} <= set(said)
    assert said["data"]["session"] == measured[-1]


def test_a_keeper_does_less_where_nothing_has_changed_and_finds_what_a_new_one_finds(tmp_path):
    lab = Lab(tmp_path)
    keeper, files = lab.keeper(), (lab.outputs.estimate, lab.outputs.flat)
    first = keeper.round()
    assert first.decision.action == "hold"
    written, names = [path.stat().st_mtime_ns for path in files], sorted(loadmat(files[1]))
    lab.now += 900.0
    again = keeper.round()
    assert again.now_h > first.now_h
    assert (id(again.followed), id(again.decision)) == (id(first.followed), id(first.decision))
    assert [path.stat().st_mtime_ns for path in files] == written
    files[1].write_bytes(b"of another program")
    lab.now += 3600.0 * first.decision.hold_hours
    asked = keeper.round()
    assert sorted(loadmat(files[1])) == names
    assert (asked.decision.action, id(asked.followed)) == ("extrinsic", id(first.followed))
    lab.measure()
    found, new = keeper.round(), lab.keeper().round()
    assert found.followed is not first.followed
    np.testing.assert_array_equal(found.followed.track.last.state.mean, new.followed.track.last.state.mean)
    assert (found.decision.hold_hours, found.valid_until_h) == (new.decision.hold_hours, new.valid_until_h)


def test_an_update_that_does_not_converge_leaves_what_was_known_and_the_loop_goes_on(tmp_path, monkeypatch):
    lab = Lab(tmp_path)
    keeper = lab.keeper()
    good = keeper.round()
    lab.now += 3600.0 * good.decision.hold_hours + 60.0
    before = keeper.round()
    name = lab.measure()
    with monkeypatch.context() as stalls:
        stalls.setattr("fpcal_bayes.tracking.filter._MAX_STEPS", 0)
        doubtful = keeper.round()
    last, expected = doubtful.followed.track.last, before.followed.track
    assert (last.session, last.converged, last.n_sweeps) == (name, False, 0)
    now = expected.drift.propagate(expected.last.state.mean, expected.last.state.covariance, last.time_h)
    for found, known in zip((last.state.mean, last.state.covariance), now, strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-12, atol=1e-12)
    said = json.loads(lab.outputs.estimate.read_text())
    assert (said["trust"]["usable"], said["fit"]["converged"], said["valid_until_h"]) == (False, False, None)
    assert f"the update of session {name} did not converge" in str(said["trust"]["reasons"])
    # It is asked for sweeps again, not for a full calibration, and what these say lifts the doubt.
    assert doubtful.decision.action == "extrinsic"
    lab.now += 60.0
    lab.measure(seed=2)
    again = keeper.round()
    assert again.followed.track.trust.usable
    assert again.valid_until_h > again.now_h
    assert json.loads(lab.outputs.estimate.read_text())["fit"]["converged"]
    assert lab.keeper().round().valid_until_h == again.valid_until_h


def test_a_campaign_that_began_badly_is_calibrated_once_more_and_not_for_ever(tmp_path):
    lab = Lab(tmp_path)
    sweeps, wrong = read_sweeps(lab.campaign, CELL), np.zeros(69)
    wrong[[7, 20, 33]] = 0.05, -0.08, 0.06
    lab.campaign.unlink()
    write_sweeps(lab.campaign, sweeps.with_measurement(sweeps.dl + wrong, sweeps.sigma), CELL)
    keeper, began = lab.keeper(), {"calibration_session": "full-T0", "campaign_began_utc": "2027-01-15T07:00:00Z"}
    lab.outputs.estimate.write_text(json.dumps(began))
    found = keeper.round()
    assert (found.decision.action, found.valid_until_h) == ("full", None)
    assert lab.measure(seed=2) == "full-1"
    lab.now += 60.0
    after = keeper.round()
    assert (after.decision.action, after.ticket.plan, after.valid_until_h) == ("hold", None, None)
    assert "begin a new campaign with the last one" in after.notes[-1]


def test_a_ticket_that_is_being_measured_stays(tmp_path):
    lab = Lab(tmp_path)
    lab.keeper().round()
    lab.now += 3 * 3600.0
    first = lab.keeper().round().ticket
    text = lab.outputs.ticket.read_bytes()
    lab.now += 1200.0
    assert lab.keeper().round().ticket.name == first.name
    assert lab.outputs.ticket.read_bytes() == text
    lab.now += 4 * 3600.0
    again = lab.keeper().round().ticket
    assert again.name != first.name
    assert again.expires_utc > lab.now


def test_what_was_asked_of_another_campaign_is_not_measured(tmp_path):
    lab = Lab(tmp_path)
    lab.keeper().round()
    lab.now += 3 * 3600.0
    assert lab.keeper().round().ticket.plan is not None
    old = lab.outputs.ticket.read_bytes()
    plan = read_sweeps(lab.outputs.ticket, CELL, plan=True)
    by_hand = simulate_um(CELL, TRUTH, plan, sigma=0.005, seed=9)
    write_sweeps(tmp_path / "hand.csv", by_hand, CELL)
    append(lab.campaign, tmp_path / "hand.csv", CELL)
    ticket = lab.keeper().round().ticket
    assert ticket.plan is None or ticket.name not in old.decode()


def test_an_append_that_was_ended_half_way_is_taken_as_done(tmp_path):
    lab = Lab(tmp_path, ".csv")
    lab.keeper().round()
    lab.now += 3 * 3600.0
    lab.keeper().round()
    ticket = lab.outputs.ticket.read_bytes()
    session = lab.measure()
    lab.outputs.ticket.write_bytes(ticket)
    before = lab.campaign.read_bytes()
    done = append(lab.campaign, tmp_path / f"{session}.csv", CELL, ticket=lab.outputs.ticket)
    assert (done.sessions, lab.campaign.read_bytes()) == ((), before)
    assert read_ticket(lab.outputs.ticket, CELL).plan is None


def test_a_campaign_in_doubt_empties_the_ticket(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lab = Lab(tmp_path, ".csv")
    lab.keeper().round()
    lab.now += 3 * 3600.0
    assert lab.keeper().round().ticket.plan is not None
    good = lab.campaign.read_text()
    lab.campaign.write_text(good.replace("um", "mm", 1))
    line = ["keep", "campaign.csv", "--ticket", "ticket.csv", "--estimate", "now.json", "--once"]
    assert main(line) == 2
    assert read_ticket(lab.outputs.ticket, CELL).plan is None
    lab.campaign.write_text(good)
    assert main([*line, "--report", "r.html", "--flat", "n.json"]) == 0
    assert (tmp_path / "r.html").exists()
    shutil.copy(lab.campaign, "again.csv")
    with pytest.raises(InputError, match="full-T0"):
        append(lab.campaign, "again.csv", CELL)


def test_the_flat_estimate_expires_by_the_clock(tmp_path):
    lab = Lab(tmp_path)
    found = lab.keeper().round()
    flat = loadmat(lab.outputs.flat)
    assert found.valid_until_h is not None
    assert float(np.squeeze(flat["valid_until_unix_s"])) == pytest.approx(1.8e9 + 3600.0 * found.valid_until_h, abs=1.0)
