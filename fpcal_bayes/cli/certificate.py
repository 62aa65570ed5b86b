"""``fpcal certificate``: a calibration handed over, as a certificate, compensation tables and the calibrated chain."""

import argparse
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.analysis.motions import axis_tables
from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256, make_folder
from fpcal_bayes.core.linalg import finite
from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.core.version import __version__
from fpcal_bayes.infer.fit.kernels import warm_up_inverse
from fpcal_bayes.infer.tasks.budget import Conditions
from fpcal_bayes.infer.tasks.source import read_knowledge
from fpcal_bayes.infer.verification.verify import read_verification
from fpcal_bayes.io.csv import write_table
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import LINK_SLOTS, SCALES, UNITS
from fpcal_bayes.motion.tasks import possible_tasks
from fpcal_bayes.motion.validity import judged_at, read_now
from fpcal_bayes.report.tasks import NOT_EVALUATED, prediction_content, reach_warnings

#: What a task's content keeps: no curves along the path.
_KEPT = ("method", "points", "points_not_ok", "peak_to_peak_nm", "normal_deg", "compensation")
#: Of `LINK_SLOTS`, those that every chain has; others stand in the table where they are used.
_GEOMETRY = 5


def run(options: argparse.Namespace, cell: Cell) -> int:
    knowledge = read_knowledge(options.file, cell)
    if knowledge.estimate is None:
        raise InputError(f"{options.file}: expected an estimate JSON, as fpcal identify --json writes")
    warm_up_inverse(cell)
    made = judged_at(knowledge.estimate, read_now(options.now, knowledge.estimate))
    verified = {}
    if options.verification is not None:
        held = read_verification(options.verification, made)
        made = replace(made, trust=made.trust.because(*held.reasons))
        verified = {"verification": held.content()}
    tasks, warnings = {}, made.trust.texts
    for own in possible_tasks(cell):
        _, task = knowledge.plan(own)
        warnings += reach_warnings(task)
        if task.ok.any():
            known = prediction_content(knowledge.predict(made, task.driven()), None, task)
            tasks[own] = {key: known[key] for key in _KEPT if key in known}
            tasks[own]["freedoms"] = {
                name: {key: value for key, value in found.items() if key.startswith("peak")}
                for name, found in known["freedoms"].items()
            }
    make_folder(options.output)
    if made.trust.usable and made.valid_until_h is None:
        what = "until when it holds is not known: hand over the estimate of fpcal track --estimate, which says"
        warnings.append(what)
    files = {"chain.csv": chain_table(made)}
    if made.trust.usable:
        files |= {f"q{joint + 1}.csv": table for joint, table in axis_tables(made).items()}
    for name, table in files.items():
        write_table(options.output / name, table)
    said = certificate(made, Path(options.file)) | {
        **verified,
        "tasks": tasks,
        "files": {name: {"sha256": file_sha256(options.output / name)} for name in files},
    }
    told = made.content()
    content = {key: told[key] for key in ("parameters", "cell", "data", "time_h", "valid_until_h")}
    content |= {"certificate": said, "warnings": warnings}
    for target in (options.output / "certificate.json", options.json):
        write_result(target, "certificate", content, made.trust)
    against = made.trust.against or "; ".join(_failed(made))
    word = f"NOT calibrated: {against}" if against else "calibrated"
    show(options, [f"{cell.name}: {word} -> {options.output} (certificate.json, {', '.join(files)})"], warnings)
    return 0


def certificate(estimate: Estimate, file: Path) -> dict[str, Any]:
    """Whether the cell is calibrated, since when, until when and under which conditions."""
    cell, usable = estimate.cell, estimate.trust.usable and not _failed(estimate)
    at = estimate.data.get("utc")
    made = clock(at).timestamp() if at else None
    until = estimate.valid_until_h if usable else None
    ends = None if made is None or until is None else iso(made + 3600.0 * (until - estimate.time_h))
    return {
        "calibrated": usable,
        "measured_utc": None if made is None else iso(made),
        "valid_until_utc": ends,
        "issued_utc": iso(time.time()),
        "issued_by": f"fpcal_bayes {__version__}",
        "estimate": {"file": file.name, "sha256": file_sha256(file)},
        "conditions": {
            "wavelength_nm": 1e3 * cell.wavelength,
            "opd": cell.opd,
            "mechanics": "perfect" if estimate.mechanics is None else "stated",
            "assumed_half_widths": asdict(Conditions()),
            "joint_ranges": {
                name: [finite(end) for end in ends]
                for name, *ends in zip(
                    cell.joint_columns, cell.low / cell.joint_scales, cell.high / cell.joint_scales, strict=True
                )
            },
            "handedness_checked": cell.handedness_checked,
        },
        "not_evaluated": list(NOT_EVALUATED),
    }


def _failed(estimate: Estimate) -> list[str]:
    """What a verification holds against it: bands may be made from it, but it is not handed over as calibrated."""
    return [reason.text for reason in estimate.trust.reasons if reason.kind == "verification"]


def chain_table(estimate: Estimate) -> dict[str, Any]:
    """The calibrated chain in the parameters of Khalil and Kleinfinger, with beta: a row per joint."""
    cell, vector, n = estimate.cell, estimate.vector(), len(estimate.cell.joints)
    sd = np.full(len(vector), np.nan)
    if estimate.trust.usable:
        sd[estimate.parameters.slots] = np.where(estimate.sd > 0, estimate.sd, np.nan)
    table: dict[str, Any] = {"joint": np.arange(1, n + 1), "kind": np.array([joint.kind for joint in cell.joints])}
    for slot, stem in enumerate(LINK_SLOTS):
        unit, own = UNITS[stem], slice(slot, slot + len(LINK_SLOTS) * n, len(LINK_SLOTS))
        if slot < _GEOMETRY or vector[own].any() or np.isfinite(sd[own]).any():
            table[f"{stem}_{unit}"], table[f"{stem}_sd_{unit}"] = vector[own] / SCALES[unit], sd[own] / SCALES[unit]
    return table
