"""Save a track in a campaign file, and take it up again."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import content_sha256
from fpcal_bayes.measure.campaign import TrackRecord
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.mechanics import Mechanics, Terms
from fpcal_bayes.model.mechanics.terms import HARMONICS, LEGENDRE
from fpcal_bayes.model.trust import trust_of
from fpcal_bayes.tracking.alarms import Limits, Monitor, Onset
from fpcal_bayes.tracking.drift import DriftModel, State
from fpcal_bayes.tracking.filter import predict
from fpcal_bayes.tracking.measurement import SweepMeasurement
from fpcal_bayes.tracking.motions import MotionStates
from fpcal_bayes.tracking.session import SessionOutcome
from fpcal_bayes.tracking.sessions import session_sha256
from fpcal_bayes.tracking.solutions import LOOKS
from fpcal_bayes.tracking.start import with_hidden_noise
from fpcal_bayes.tracking.tracker import Track, calibration_measurement

_PLAIN = ("session", "time_h", "utc", "n_sweeps", "nis", "dof", "verdict", "log_likelihood", "converged")
_ONSET = ("session", "hours", "age", "squared", "dof")

#: The track that was saved or read last, by cell, drift and record, for who follows one campaign again and again.
_last: dict[tuple[Any, ...], Track] = {}


def settings_sha256(drift: DriftModel, limits: Limits, sizes: Mechanics | None = None) -> str:
    """Hash of what a track depends on beside cell and sweeps: drift sizes, limits of the tests, error motions."""
    motions = [] if sizes is None else [sizes.sha256, LEGENDRE, HARMONICS]
    return content_sha256([[size.content() for size in drift.sizes], asdict(limits), *motions])


def record_of(track: Track, sweeps: Sweeps, limits: Limits) -> TrackRecord:
    """A track as a campaign file holds it; hashes of the `sweeps` tell later which sessions the states hold."""
    if track.drift.motions is not None:
        # The memory of the tests is large then, and kept for the last session alone.
        before = [replace(outcome, monitor=replace(outcome.monitor, onsets=())) for outcome in track.outcomes[:-1]]
        track = replace(track, outcomes=(*before, track.last))
    onsets = [onset for outcome in track.outcomes for onset in outcome.monitor.onsets]
    n, states = track.drift.n_parameters, track.drift.n_states
    summary = {
        "sessions": [_summary(outcome, sweeps) for outcome in track.outcomes],
        "status": track.status,
        "solutions": track.solutions,
        "pace": track.drift.pace,
        "from_prior": track.outcomes[0].measurement is not None,
        "trust": track.trust.content(),
    } | _motions_content(track.outcomes[0])
    record = TrackRecord(
        cell_sha256=track.cell.sha256,
        settings_sha256=settings_sha256(track.drift, limits, track.cell.mechanics),
        names=track.drift.parameters.names,
        summary=json.dumps(summary, allow_nan=False),
        mean=np.array([outcome.state.mean for outcome in track.outcomes]),
        covariance=np.array([outcome.state.covariance for outcome in track.outcomes]),
        jump=np.array([outcome.jump for outcome in track.outcomes]),
        onset_response=np.array([onset.response for onset in onsets]).reshape(-1, states, n),
        onset_information=np.array([onset.information for onset in onsets]).reshape(-1, n, n),
        onset_score=np.array([onset.score for onset in onsets]).reshape(-1, n),
    )
    _remember(_key(record, track.cell, replace(track.drift, pace=(1.0, 1.0))), track)
    return record


def _key(record: TrackRecord, cell: Cell, drift: DriftModel) -> tuple[Any, ...]:
    arrays = (value.tobytes() for value in vars(record).values() if isinstance(value, np.ndarray))
    return cell, drift, record.summary, *arrays


def _remember(key: tuple[Any, ...], track: Track) -> None:
    _last.clear()
    _last[key] = track


def resume(
    record: TrackRecord, cell: Cell, drift: DriftModel, limits: Limits, parts: list[Sweeps], file: str
) -> tuple[Track | None, str]:
    """The part of a saved track that still holds, or None if all is to be taken in anew; and why, or an empty text.

    It ends before the first of the sessions `parts` that is new, was changed, or came in between late. `InputError` if
    the track is of another cell, or cannot be understood.
    """
    if record.cell_sha256 != cell.sha256 or record.names != drift.parameters.names:
        raise InputError(
            f"{file}: the track saved in it is of another cell or path model ({record.cell_sha256[:8]}), expected "
            f"{cell.name!r}, opd {cell.opd!r} ({cell.sha256[:8]}); give --anew to replace it"
        )
    if record.settings_sha256 != settings_sha256(drift, limits, cell.mechanics):
        return None, "drift, limits or error motions are no longer the saved track's: all sessions are taken in anew"
    try:
        summary, key = json.loads(record.summary), _key(record, cell, drift)
        track = _last.get(key) or _track(record, summary, cell, drift)
        hashes = [] if track is None else [[each["session"], each["sha256"]] for each in summary["sessions"]]
        from_prior = track is not None and bool(summary["from_prior"])
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{file}: the saved track cannot be read ({error}); give --anew to replace it") from error
    if track is None:
        return None, "the track was saved by an older version: all sessions are taken in anew"
    kept = 0
    for stated, part in zip(hashes, parts, strict=False):
        if stated != [str(part.session[0]), session_sha256(part)]:
            break
        kept += 1
    if kept == 0:
        return None, "the first session is not that of the saved track: all sessions are taken in anew"
    reason = "" if kept == len(hashes) else f"sessions after {track.outcomes[kept - 1].session} are taken in anew"
    nothing_new = kept == len(hashes) == len(parts)
    if track.solutions > 1 and kept <= LOOKS and not nothing_new:
        return None, f"its calibration has {track.solutions} solutions: all of its first sessions are taken in anew"
    machine = track.drift.motions is not None
    if machine and kept < len(hashes):
        return None, f"{reason}: with all before them"
    first = track.outcomes[0]
    if from_prior and first.measurement is None:
        if machine:
            first = _with_rows(track, parts[0], summary["motions"]["rows"])
        else:
            first = replace(first, measurement=calibration_measurement(cell, drift, parts[0]))
        track = replace(track, outcomes=(first, *track.outcomes[1:]))
        _remember(key, track)
    return replace(track, outcomes=track.outcomes[:kept], resumed=kept), reason


def _summary(outcome: SessionOutcome, sweeps: Sweeps) -> dict[str, Any]:
    monitor, temperature = outcome.monitor, outcome.state.temperature_c
    return {
        **{name: getattr(outcome, name) for name in _PLAIN},
        "sha256": session_sha256(sweeps.of_session(outcome.session)),
        "evidence": outcome.evidence,
        "warnings": outcome.warnings,
        "trust": outcome.trust.content(),
        "temperature_c": None if np.isnan(temperature) else temperature,
        "recent": monitor.recent,
        "cusum": [monitor.cusum_extrinsic, monitor.cusum_residual],
        "onsets": [{name: getattr(onset, name) for name in _ONSET} for onset in monitor.onsets],
    }


def _motions_content(first: SessionOutcome) -> dict[str, Any]:
    if first.motions is None:
        return {}
    rows = first.measurement.target.tolist() if isinstance(first.measurement, SweepMeasurement) else None
    found = {"log_scales": first.motions.log_scales.tolist(), "session_min": first.motions.session_min}
    return {"motions": found | {"rows": rows}}


def _with_rows(track: Track, sweeps: Sweeps, rows: Sequence[float]) -> SessionOutcome:
    first, used = track.outcomes[0], sweeps.take(sweeps.kind != "path")
    model = CavityModel.of(track.cell, track.drift.parameters)
    measurement = SweepMeasurement.of(track.drift, model, used, first.state.mean)
    return replace(first, measurement=replace(measurement, target=np.array(rows)))


def _motions(stated: dict[str, Any] | None, cell: Cell, drift: DriftModel) -> MotionStates | None:
    if stated is None or cell.mechanics is None:
        return None
    terms = Terms.of(cell, cell.mechanics, drift.parameters.names)
    log_scales = np.array(stated["log_scales"], dtype=float)
    if log_scales.ndim != 2 or log_scales.shape[1] != len(terms.scales) or not np.isfinite(log_scales).all():
        raise ValueError("its factors on the stated sizes do not fit the cell")
    return MotionStates(terms, log_scales, float(stated["session_min"]))


def _track(record: TrackRecord, summary: dict[str, Any], cell: Cell, drift: DriftModel) -> Track | None:
    whole = "solutions" in summary and all("trust" in stated for stated in summary.get("sessions", ()))
    if "sessions" in summary and not whole:
        return None
    outcomes: list[SessionOutcome] = []
    pace = tuple(float(each) for each in summary.get("pace", (1.0, 1.0)))
    if len(pace) != 2 or not all(0.0 < each < np.inf for each in pace):
        raise ValueError("its pace is no pair of factors")
    drift, at = replace(drift, motions=_motions(summary.get("motions"), cell, drift), pace=pace), 0
    for i, stated in enumerate(summary["sessions"]):
        logged = stated["temperature_c"]
        temperature = float("nan") if logged is None else float(logged)
        state = State(stated["time_h"], record.mean[i], record.covariance[i], temperature)
        if not outcomes:
            drift = with_hidden_noise(drift, CavityModel.of(cell, drift.parameters), state)
        predicted = predict(drift, outcomes[-1].state, state.time_h, temperature) if outcomes else state
        onsets = []
        for entry in stated["onsets"]:
            response, information = record.onset_response[at], record.onset_information[at]
            onsets.append(Onset(**entry, response=response, information=information, score=record.onset_score[at]))
            at += 1
        outcomes.append(
            SessionOutcome(
                **{name: stated[name] for name in _PLAIN},
                evidence=tuple(stated["evidence"]),
                warnings=tuple(stated["warnings"]),
                jump=record.jump[i],
                predicted=predicted,
                state=state,
                monitor=Monitor(tuple(onsets), tuple((x, n) for x, n in stated["recent"]), *stated["cusum"]),
                trust=trust_of(stated["trust"]),
                motions=None if outcomes else drift.motions,
            )
        )
    if len(record.mean) != len(outcomes) or record.mean.shape[1] != drift.n_states:
        raise ValueError("its arrays do not fit its sessions")
    return Track(cell, drift, tuple(outcomes), tuple(summary["status"]), 0, int(summary["solutions"]))
