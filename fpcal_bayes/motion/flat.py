"""The current best estimate as flat names and arrays, for controllers in MATLAB or LabVIEW."""

from typing import Any

import numpy as np

from fpcal_bayes.core.times import clock, iso
from fpcal_bayes.model import chain
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics import weight_rows
from fpcal_bayes.model.parameters import EXTRINSICS, LINK_SLOTS, UNITS
from fpcal_bayes.motion.placement import Placement

SCHEMA = "fpcal-flat/1"
#: A limit that no joint reaches, where the cell states none: JSON has no infinity.
_NO_LIMIT = 1e12


def flat_content(estimate: Estimate) -> dict[str, Any]:
    """The calibrated chain, frames, verdict and expiry of an estimate; every name ends in its unit.

    Lists hold one number per joint, or the rows of 4 x 4 transforms; None stands where an expiry is not known.
    `fpcal_fk.m` and `fpcal_ik.m` read it.
    """
    cell, vector = estimate.cell, estimate.vector()
    placement, n = Placement.of(cell, vector), len(cell.joints)
    links = vector[: n * len(LINK_SLOTS)].reshape(n, len(LINK_SLOTS))
    shown = estimate.shown()
    until_h, made = estimate.valid_until_h, estimate.data.get("utc", "")
    until_s = None
    if until_h is not None and made:
        until_s = clock(made).timestamp() + 3600.0 * (until_h - estimate.time_h)
    low, high = (np.clip(side / cell.joint_scales, -_NO_LIMIT, _NO_LIMIT) for side in (cell.low, cell.high))
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "cell": cell.name,
        "cell_sha256": cell.sha256,
        "opd": cell.opd,
        "optical_axis": cell.optical_axis,
        "usable": int(estimate.trust.usable),
        "verdict": estimate.trust.verdict,
        "reasons": "; ".join(estimate.trust.texts),
        "session": estimate.data.get("session", ""),
        "time_h": estimate.time_h,
        "utc": made,
        "valid_until_h": until_h,
        "valid_until_utc": "" if until_s is None else iso(until_s),
        "valid_until_unix_s": until_s,
        "n_joints": n,
        "joint_names": list(cell.joint_columns),
        "joint_revolute": cell.revolute.astype(int).tolist(),
        "joint_low": low.tolist(),
        "joint_high": high.tolist(),
    }
    for slot, name in enumerate(LINK_SLOTS):
        unit = UNITS[name]
        content[f"link_{name}_{unit}"] = (links[:, slot] / _scale(unit)).tolist()
    for name, value in zip(EXTRINSICS, vector[-len(EXTRINSICS) :].tolist(), strict=True):
        content[f"{name}_{UNITS[name]}"] = value / _scale(UNITS[name])
    for parameter in estimate.parameters:
        content[f"{parameter.name}_sd_{parameter.unit}"] = shown[parameter.name]["sd"]
    frames = {
        "fibre_in_world": placement.fibre,
        "mirror_in_tool": chain.mirror_in_tool(cell, vector),
        "point_in_tool": np.linalg.inv(placement.tool_in_point),
        "aligned_pose": placement.aligned,
    }
    return content | {name: frame.tolist() for name, frame in frames.items()} | _compensation(estimate)


def _compensation(estimate: Estimate) -> dict[str, Any]:
    """Error motions by joint, a row per weight: kind and order, stated size in um or rad, posterior mean in it."""
    known = estimate.mechanics
    if known is None:
        return {"compensation": 0}
    terms, (weights, factor) = known.terms(estimate.cell), known.known_motions
    rows = [(joint, [*row, mean]) for (joint, *row), mean in zip(weight_rows(terms), weights.tolist(), strict=True)]
    joints = range(len(estimate.cell.joints))
    return {
        "compensation": 1,
        "return_sd_um_rad": (factor * terms.return_sd).tolist(),
        "encoder_period_um_rad": np.nan_to_num(terms.encoder_period).tolist(),
        "motion_lever_um": terms.told.lever.tolist(),
        **{f"motion_axes_q{i + 1}": terms.told.in_base[i].tolist() for i in joints},
        **{f"motions_q{i + 1}": [row for joint, row in rows if joint == i] for i in joints},
    }


def _scale(unit: str) -> float:
    return {"deg": float(np.radians(1.0)), "um": 1.0, "ppm": 1e-6}[unit]
