"""`fpcal keep --rig`: an emulated cell keeps itself calibrated."""

import time

import pytest
from rig_fixtures import live, write_ticket

from fpcal_bayes.cli.main import main
from fpcal_bayes.io.campaign import read_campaign
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.io.tickets import read_ticket

pytest.importorskip("pipython")


@pytest.mark.slow
def test_the_loop_closes_on_the_emulated_cell(femto, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with live(femto, tmp_path, speedup=2000.0) as cell:
        cell.measure(write_ticket(tmp_path / "day0.csv", femto, session="full-T0"), tmp_path / "campaign.h5")
        line = "keep campaign.h5 --ticket ticket.csv --estimate now.json --rig live.toml --once --tolerance-nm 50"
        deadline = time.monotonic() + 60.0
        while len(read_sweeps("campaign.h5", femto).sessions) < 3 and time.monotonic() < deadline:
            assert main(line.split()) == 0, capsys.readouterr().err
            time.sleep(0.5)
        campaign = read_campaign("campaign.h5", femto)
        assert len(campaign.sweeps.sessions) >= 3
        assert campaign.track is not None
        assert read_ticket("ticket.csv", femto).plan is None
        assert (campaign.sweeps.utc != "").all()
        assert all(allowed for _, _, allowed in cell.lab.commanded)
