"""Campaign files in HDF5: sweeps with the cell, the program, and the truth, track and recordings beside."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import CONTENT_HASH, content_sha256, replacing
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.columns import Column, from_columns, get_columns, put_columns, to_columns
from fpcal_bayes.io.hdf5 import Reader, put_array, put_text, reading, writing
from fpcal_bayes.io.recordings_hdf5 import ends_of, get_index, get_pieces, put_index
from fpcal_bayes.measure.campaign import Campaign, DoubtfulRecord, TrackRecord
from fpcal_bayes.measure.truth import TruthRecord
from fpcal_bayes.model.cell.beams import Opd
from fpcal_bayes.model.cell.cell import Cell

SCHEMA = "fpcal-campaign"
SCHEMA_VERSION = 1

#: Arrays of a track record and their number of axes: covariances are triangles, in older files whole.
_TRACK_ARRAYS = {
    "mean": 2,
    "covariance": None,
    "jump": 2,
    "onset_response": 3,
    "onset_information": 3,
    "onset_score": 2,
}
#: Texts and numbers of a doubtful record, the numbers with their units.
_DOUBTFUL_TEXTS = ("session", "label", "reason")
_DOUBTFUL_NUMBERS = {"recording": "", "dl_um": "um", "sigma_um": "um", "signed": ""}


def write_campaign(
    path: str | Path, campaign: Campaign, cell: Cell, *, asked: Mapping[str, Column] | None = None
) -> None:
    """Write a campaign to HDF5, whole or not at all, equal content as equal bytes; `asked` as in `to_columns`."""
    path = Path(path)
    _require_cell(path, campaign.cell_name, campaign.cell_sha256, campaign.opd, cell)
    table = to_columns(campaign.sweeps, cell, path, asked)
    if campaign.seed is not None and not 0 <= campaign.seed < 2**63:
        raise InputError(f"{path}: seed {campaign.seed}: expected a whole number from 0 to 2^63 - 1")
    with replacing(path) as temporary, writing(temporary) as root:
        for name in ("program_version", "cell_name", "cell_sha256", "opd", "command"):
            put_text(root, name, getattr(campaign, name))
        put_text(root, "schema", SCHEMA)
        root.attrs["schema_version"] = SCHEMA_VERSION
        if campaign.seed is not None:
            root.attrs["seed"] = campaign.seed
        if campaign.about:
            put_text(root, "about", campaign.about)
        put_columns(root.create_group("sweeps"), table)
        if campaign.truth is not None:
            truth = root.create_group("truth")
            put_array(truth, "names", campaign.truth.names)
            put_array(truth, "units", campaign.truth.units)
            put_array(truth, "time_h", campaign.truth.times_h, "h")
            put_array(truth, "values", campaign.truth.values)
        if campaign.track is not None:
            put_track(root.create_group("track"), campaign.track)
        if campaign.recordings is not None:
            put_index(root.create_group("recordings"), campaign.recordings, cell, path)
        if campaign.doubtful is not None:
            put_doubtful(root.create_group("doubtful"), campaign.doubtful)


def read_campaign(path: str | Path, cell: Cell, *, plan: bool = False, whole: bool = False) -> Campaign:
    """Read a campaign of a cell, whose path model may differ, from HDF5; `plan`, `whole` as in `read_sweeps`."""
    path = Path(path)
    with reading(path) as reader:
        root = reader.root
        schema, version = reader.text_attribute(root, "schema"), reader.integer_attribute(root, "schema_version")
        if schema != SCHEMA:
            raise InputError(f"{path}: expected an HDF5 file of schema {SCHEMA}, found {schema!r:.40}")
        if version > SCHEMA_VERSION:
            raise InputError(f"{path}: written by a newer fpcal: schema {version}, this program reads {SCHEMA_VERSION}")
        if version < 1:
            raise InputError(f"{path}: expected schema_version {SCHEMA_VERSION}, found {version}")
        name, sha256, program, command = (
            reader.text_attribute(root, key) for key in ("cell_name", "cell_sha256", "program_version", "command")
        )
        text = reader.text_attribute(root, "opd")
        opd: Opd | None = next((choice for choice in get_args(Opd) if choice == text), None)
        if opd is None:
            raise InputError(f"{path}: attribute opd: expected one of {', '.join(get_args(Opd))}, found {text!r:.40}")
        seed = reader.integer_attribute(root, "seed") if "seed" in root.attrs else None
        about = reader.text_attribute(root, "about") if "about" in root.attrs else ""
        _require_cell(path, name, sha256, opd, cell)
        table = get_columns(reader, reader.group(root, "sweeps"), cell, plan=plan)
        truth = None
        if reader.has(root, "truth"):
            group = reader.group(root, "truth")
            names, units = (tuple(reader.texts(group, name).tolist()) for name in ("names", "units"))
            truth = TruthRecord(names, units, reader.numbers(group, "time_h"), reader.numbers(group, "values", 2))
        track = get_track(reader, reader.group(root, "track")) if reader.has(root, "track") else None
        recorded = reader.has(root, "recordings")
        recordings = get_index(reader, reader.group(root, "recordings"), cell) if recorded else None
        doubtful = get_doubtful(reader, reader.group(root, "doubtful")) if reader.has(root, "doubtful") else None
    if truth is not None:
        truth.check(cell, f"{path}: /truth")
    rows = np.arange(1, len(next(iter(table.values()))) + 1)
    return Campaign(
        sweeps=from_columns(table, cell, str(path), rows, plan=plan, whole=whole),
        cell_name=name,
        cell_sha256=sha256,
        opd=opd,
        program_version=program,
        command=command,
        seed=seed,
        truth=truth,
        track=track,
        recordings=recordings,
        doubtful=doubtful,
        about=about,
    )


def _require_cell(path: Path, name: str, sha256: str, opd: Opd, cell: Cell) -> None:
    own = cell.with_opd(opd).sha256
    if own != sha256:
        raise InputError(
            f"{path}: made with cell {name!r:.60} (sha256 {sha256[:8]!r:.40}), "
            f"expected cell {cell.name!r} (sha256 {own[:8]!r}); give the file's own cell with --cell"
        )


def put_track(group: Any, record: TrackRecord) -> None:
    """Store a record in an HDF5 group."""
    put_text(group, "cell_sha256", record.cell_sha256)
    put_text(group, "settings_sha256", record.settings_sha256)
    put_array(group, "names", record.names)
    put_array(group, "json", [record.summary])
    for name in _TRACK_ARRAYS:
        values = getattr(record, name)
        put_array(group, name, _triangles(values) if name == "covariance" else values)
    put_text(group, CONTENT_HASH, _track_sha256(record))


def _triangles(matrices: Floats) -> Floats:
    """The lower triangles of matrices (n, m, m), shape (n, m (m + 1) / 2); the matrices where these do not tell all."""
    rows, columns = np.tril_indices(matrices.shape[1])
    packed: Floats = matrices[:, rows, columns]
    return packed if _whole(packed, matrices.shape[1]).tobytes() == matrices.tobytes() else matrices


def _whole(packed: Floats, size: int) -> Floats:
    """The symmetric matrices (n, size, size) of which these are the lower triangles."""
    rows, columns = np.tril_indices(size)
    matrices = np.empty((len(packed), size, size))
    matrices[:, rows, columns] = matrices[:, columns, rows] = packed
    return matrices


def _track_sha256(record: TrackRecord) -> str:
    arrays = {name: hashlib.sha256(np.ascontiguousarray(getattr(record, name))).hexdigest() for name in _TRACK_ARRAYS}
    return content_sha256([record.cell_sha256, record.settings_sha256, list(record.names), record.summary, arrays])


def get_track(reader: Reader, group: Any) -> TrackRecord:
    """Read a record from an HDF5 group; `InputError` if anything in it is not as `put_track` writes it."""
    texts = reader.texts(group, "json")
    if len(texts) != 1:
        raise InputError(f"{reader.path}: {group.name}/json: expected one text, found {len(texts)}")
    arrays = {name: reader.numbers(group, name, ndim) for name, ndim in _TRACK_ARRAYS.items()}
    sessions, states = arrays["mean"].shape
    if arrays["covariance"].shape == (sessions, states * (states + 1) // 2):
        arrays["covariance"] = _whole(arrays["covariance"], states)
    if arrays["covariance"].shape != (sessions, states, states) or arrays["jump"].shape != (sessions, states):
        raise InputError(f"{reader.path}: {group.name}/covariance: expected the shape that mean has")
    if not all(np.isfinite(values).all() for values in arrays.values()):
        raise InputError(f"{reader.path}: {group.name}: expected finite numbers")
    record = TrackRecord(
        cell_sha256=reader.text_attribute(group, "cell_sha256"),
        settings_sha256=reader.text_attribute(group, "settings_sha256"),
        names=tuple(reader.texts(group, "names").tolist()),
        summary=str(texts[0]),
        **arrays,
    )
    # Older programs wrote none.
    if CONTENT_HASH in group.attrs and reader.text_attribute(group, CONTENT_HASH) != _track_sha256(record):
        raise InputError(f"{reader.path}: {group.name}: the saved track is not what the program wrote")
    return record


def put_doubtful(group: Any, record: DoubtfulRecord) -> None:
    """Store a record in an HDF5 group; alternatives lie one after the other, ``alternatives_end`` cuts them."""
    for name in _DOUBTFUL_TEXTS:
        put_array(group, name, getattr(record, name))
    values = (record.recording, record.dl, record.sigma, record.signed.astype(np.uint8))
    for (name, unit), array in zip(_DOUBTFUL_NUMBERS.items(), values, strict=True):
        put_array(group, name, array, unit)
    put_array(group, "alternatives_um", np.array([x for each in record.alternatives for x in each]), "um")
    put_array(group, "alternatives_end", ends_of(record.alternatives))


def get_doubtful(reader: Reader, group: Any) -> DoubtfulRecord:
    """Read a record from an HDF5 group; `InputError` if anything in it is not as `put_doubtful` writes it."""
    session, label, reason = (reader.texts(group, name) for name in _DOUBTFUL_TEXTS)
    recording, dl, sigma, signed = (reader.numbers(group, name) for name in _DOUBTFUL_NUMBERS)
    n = len(dl)
    if any(len(column) != n for column in (session, label, reason, recording, sigma, signed)):
        raise InputError(f"{reader.path}: {group.name}: expected {n} values in every column")
    if not np.isfinite(recording).all():
        raise InputError(f"{reader.path}: {group.name}/recording: expected finite numbers")
    pieces = get_pieces(reader, group, "alternatives_end", ("alternatives_um",), n)
    alternatives = tuple(tuple(piece.tolist()) for (piece,) in pieces)
    return DoubtfulRecord(session, label, reason, recording.astype(np.int64), dl, sigma, signed == 1, alternatives)
