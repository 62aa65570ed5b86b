"""What commands that follow a campaign share: read it, and take in its sessions."""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.cli.common import warm_up
from fpcal_bayes.errors import InputError
from fpcal_bayes.model.cell import Cell

if TYPE_CHECKING:
    from fpcal_bayes.measure.campaign import Campaign
    from fpcal_bayes.measure.sweeps import Sweeps
    from fpcal_bayes.track.drift import DriftModel
    from fpcal_bayes.track.tracker import Track

Floats = NDArray[np.float64]
#: Of a posterior file: more tell no more.
_MOST_DRAWS = 2000


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


def follow(options: argparse.Namespace, cell: Cell, *, anew: bool = False, posterior: str | None = None) -> Followed:
    """Follow the campaign that the options name, from where a saved track ends.

    Parameters
    ----------
    anew
        From its first session on instead.
    posterior
        File of draws to start from, as ``fpcal sample`` writes it; from the first session on too.
    """
    from fpcal_bayes.files import file_sha256
    from fpcal_bayes.measure.campaign import read_campaign
    from fpcal_bayes.measure.sweep_files import is_campaign_file, read_sweeps
    from fpcal_bayes.track.consistency import Limits
    from fpcal_bayes.track.likely_terms import likely_drift
    from fpcal_bayes.track.record import resume
    from fpcal_bayes.track.sessions import check_sessions, hours_of
    from fpcal_bayes.track.tracker import track

    campaign = read_campaign(options.campaign, cell) if is_campaign_file(options.campaign) else None
    sweeps = read_sweeps(options.campaign, cell) if campaign is None else campaign.sweeps
    drift, limits = likely_drift(cell, sweeps), Limits()
    now_h = None if options.now is None else hours_of(options.now, sweeps)
    parts = check_sessions(sweeps, now_h)
    notes: list[str] = []
    draws = None if posterior is None else _draws(posterior, cell, drift)
    known = None
    if campaign is not None and campaign.track is not None and not anew and draws is None:
        known, note = resume(campaign.track, cell, drift, limits, parts, options.campaign)
        notes += [note] if note else []
    warm_up(cell)
    found = track(cell, sweeps, drift=drift, limits=limits, known=known, draws=draws, now_h=now_h)
    data = {"file": Path(options.campaign).name, "sha256": file_sha256(Path(options.campaign))}
    utc = {"utc": found.last.utc} if found.last.utc else {}
    found = replace(found, data=data | {"session": found.last.session} | utc)
    return Followed(found, sweeps, now_h, notes, campaign)


def _draws(posterior: str, cell: Cell, drift: "DriftModel") -> Floats:
    """The draws of the parameters that are followed, shape (n_draws, n_parameters)."""
    from fpcal_bayes.infer.posterior_file import read_posterior

    read = read_posterior(posterior, cell)
    missing = [name for name in drift.parameters.names if name not in read.parameters]
    if missing:
        raise InputError(f"{posterior}: expected draws of all free parameters, {missing[0]} is missing")
    drawn = read.thinned(_MOST_DRAWS)
    if len(drawn.values) <= len(drift.parameters):
        raise InputError(f"{posterior}: {len(drawn.values)} draws, expected more than parameters")
    return drawn.values[:, drawn.parameters.positions(drift.parameters.names)]
