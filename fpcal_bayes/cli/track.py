"""``fpcal track``: follow the parameters of a cell from session to session."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from fpcal_bayes.cli.common import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    warm_up,
    warn,
    write_result,
)
from fpcal_bayes.errors import InputError

_EPILOG = """\
The first session of CAMPAIGN is the full calibration, the following ones update it: any number of sweeps, at any time.
Sessions may stand in any order; one that arrives late takes its place. In an HDF5 campaign the states are saved, and
the next run takes in what is new; a CSV is never changed.

Verdict of a session: as-modelled; extrinsics-moved (mirror or fibre moved more than their drift: their uncertainty is
widened and the session taken in anew); intrinsics-moved (the robot itself changed: a full calibration is due).

ESTIMATE is replaced as a whole, so a controller may read it at any time.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "track", "follow the parameters from session to session", run, _EPILOG)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="sweeps of all sessions: HDF5 campaign, or CSV")
    parser.add_argument("--estimate", metavar="OUT", type=Path, help="write the current best estimate as JSON")
    parser.add_argument("--now", metavar="TIME_H|UTC", help="refuse sessions after this time (default: this clock)")
    parser.add_argument("--anew", action="store_true", help="take in all sessions again, whatever was saved")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.files import file_sha256
    from fpcal_bayes.measure.campaign import read_campaign, write_campaign
    from fpcal_bayes.measure.sweep_files import is_campaign_file, read_sweeps
    from fpcal_bayes.report.tables import parameter_table
    from fpcal_bayes.report.track_text import session_table, time_text, verdict_lines
    from fpcal_bayes.track.consistency import Limits
    from fpcal_bayes.track.drift import DriftModel
    from fpcal_bayes.track.record import record_of, resume
    from fpcal_bayes.track.sessions import check_sessions, hours_of
    from fpcal_bayes.track.tracker import track

    cell = cell_of(options)
    for output in (options.estimate, options.json):
        check_output(output, options.campaign)
    if options.estimate is not None and options.json is not None and options.estimate == options.json:
        raise InputError(f"{options.json}: expected two names for --estimate and --json")
    drift, limits = DriftModel.of(cell), Limits()
    campaign = read_campaign(options.campaign, cell) if is_campaign_file(options.campaign) else None
    sweeps = read_sweeps(options.campaign, cell) if campaign is None else campaign.sweeps
    now_h = None if options.now is None else hours_of(options.now, sweeps)
    parts = check_sessions(sweeps, now_h)
    notes: list[str] = []
    known = None
    if campaign is not None and campaign.track is not None and not options.anew:
        known, note = resume(campaign.track, cell, drift, limits, parts, options.campaign)
        notes += [note] if note else []
    warm_up(cell)
    found = track(cell, sweeps, drift=drift, limits=limits, known=known, now_h=now_h)
    if campaign is not None and found.resumed < len(found.outcomes):
        try:
            write_campaign(options.campaign, replace(campaign, track=record_of(found, sweeps, limits)), cell)
        except InputError as error:
            notes.append(f"the states are not saved: {error}")
    data = {"file": Path(options.campaign).name, "sha256": file_sha256(Path(options.campaign))}
    found = replace(found, data=data | {"session": found.last.session})

    out = console(options)
    out.print(session_table(found, f"{options.campaign}: {len(found.outcomes)} sessions, {found.resumed} known before"))
    title = f"after session {found.last.session}, {time_text(found.last.time_h, found.outcomes)}"
    out.print(parameter_table(found.estimate(), title))
    lines = verdict_lines(found)
    warnings = [f"{o.session}: {text}" for o in found.outcomes for text in o.warnings] + lines + notes
    warn(warnings)
    if options.estimate is not None:
        write_result(options.estimate, "track", found.estimate().content() | {"fit": _fit(found)})
    write_result(options.json, "track", _content(found) | {"warnings": warnings})
    return 0 if found.converged else 1


def _fit(found: Any) -> dict[str, Any]:
    last = found.last
    return {"n_sweeps": sum(o.n_sweeps for o in found.outcomes), "nis": last.nis, "converged": found.converged}


def _content(found: Any) -> dict[str, Any]:
    """What ``track --json`` writes, without schema, command and warnings."""
    return {
        **found.estimate().content(),
        "fit": _fit(found),
        "sessions": [
            {
                "session": outcome.session,
                "time_h": outcome.time_h,
                "n_sweeps": outcome.n_sweeps,
                "nis": outcome.nis,
                "dof": outcome.dof,
                "verdict": outcome.verdict,
                "evidence": list(outcome.evidence),
            }
            for outcome in found.outcomes
        ],
        "calibration_due": found.calibration_due is not None,
    }
