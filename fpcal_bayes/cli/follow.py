"""What commands that follow a campaign share: read it, and take in its sessions."""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from fpcal_bayes.cli.common import warm_up
from fpcal_bayes.model.cell import Cell

if TYPE_CHECKING:
    from fpcal_bayes.measure.campaign import Campaign
    from fpcal_bayes.measure.sweeps import Sweeps
    from fpcal_bayes.track.tracker import Track


@dataclass(frozen=True)
class Followed:
    """A campaign as it was read and followed.

    Attributes
    ----------
    track, sweeps
        Up to the last session, and all its rows.
    now_h
        The time that the user gave, or None.
    notes
        Sentences about what was saved before.
    campaign
        The campaign file, or None if it is a CSV.
    """

    track: "Track"
    sweeps: "Sweeps"
    now_h: float | None
    notes: list[str]
    campaign: "Campaign | None"


def follow(options: argparse.Namespace, cell: Cell, *, anew: bool = False) -> Followed:
    """Follow the campaign that the options name, from where a saved track ends."""
    from fpcal_bayes.files import file_sha256
    from fpcal_bayes.measure.campaign import read_campaign
    from fpcal_bayes.measure.sweep_files import is_campaign_file, read_sweeps
    from fpcal_bayes.track.consistency import Limits
    from fpcal_bayes.track.drift import DriftModel
    from fpcal_bayes.track.record import resume
    from fpcal_bayes.track.sessions import check_sessions, hours_of
    from fpcal_bayes.track.tracker import track

    drift, limits = DriftModel.of(cell), Limits()
    campaign = read_campaign(options.campaign, cell) if is_campaign_file(options.campaign) else None
    sweeps = read_sweeps(options.campaign, cell) if campaign is None else campaign.sweeps
    now_h = None if options.now is None else hours_of(options.now, sweeps)
    parts = check_sessions(sweeps, now_h)
    notes: list[str] = []
    known = None
    if campaign is not None and campaign.track is not None and not anew:
        known, note = resume(campaign.track, cell, drift, limits, parts, options.campaign)
        notes += [note] if note else []
    warm_up(cell)
    found = track(cell, sweeps, drift=drift, limits=limits, known=known, now_h=now_h)
    data = {"file": Path(options.campaign).name, "sha256": file_sha256(Path(options.campaign))}
    found = replace(found, data=data | {"session": found.last.session})
    return Followed(found, sweeps, now_h, notes, campaign)
