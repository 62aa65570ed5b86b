"""Sizes of error motions from a cell's TOML tables, in the words of data sheets."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics

#: Keys that are meant for one kind of joint only, beside those in their own unit.
_LINEAR_ONLY = ("straightness_nm", "flatness_nm", "pitch_urad", "yaw_urad", "roll_urad", "crosstalk_nm")
_TURNING_ONLY = ("radial_runout_nm", "axial_runout_nm", "wobble_urad")
_IN_OWN_UNIT = ("linearity", "reversal", "return", "encoder")
#: No error motion of a positioner is as large as a millimetre or a milliradian times ten.
_LARGEST = 1e6


def joint_mechanics(table: Mapping[str, Any], *, prismatic: bool, place: str) -> JointMechanics:
    """The sizes that a table ``[joint.mechanics]`` states, of a joint that moves along (nm) or turns (urad)."""
    own, shown = ("nm", "um") if prismatic else ("urad", "deg")
    names = {key: key for key in (_LINEAR_ONLY if prismatic else _TURNING_ONLY)}
    names |= {f"{stem}_{own}": {"return": "return_sd"}.get(stem, stem) for stem in _IN_OWN_UNIT}
    names[f"encoder_period_{shown}"] = "encoder_period"
    known = (*names, "lever_mm", "source")
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            raise InputError(f"{place}.{key}: unknown key, expected one of {', '.join(sorted(known))}")
        if key == "source":
            if not isinstance(value, str):
                raise InputError(f"{place}.source: expected a text")
            values[key] = value
        elif key == "lever_mm":
            if not isinstance(value, list) or len(value) != 3:
                raise InputError(f"{place}.lever_mm: expected three numbers, from the sheet's point to the mirror")
            values[key] = tuple(_number(part, f"{place}.lever_mm", -1e4, 1e4) for part in value)
        else:
            low = 1e-9 if key.startswith("encoder_period") else 0.0
            values[names[key]] = _number(value, f"{place}.{key}", low, _LARGEST)
    return JointMechanics(**values)


def cell_mechanics(table: Mapping[str, Any], joints: tuple[JointMechanics, ...], *, place: str) -> Mechanics:
    """The sizes that a cell's table ``[mechanics]`` adds to those of its joints."""
    known = {"drift_nm_per_min": 0.0, "minutes_per_sweep": 1e-6, "correlated_nm": 0.0}
    for key in table:
        if key not in known:
            raise InputError(f"{place}.{key}: unknown key, expected one of {', '.join(sorted(known))}")
    values = {key: _number(value, f"{place}.{key}", known[key], _LARGEST) for key, value in table.items()}
    return Mechanics(joints, **values)


def _number(value: Any, place: str, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise InputError(f"{place}: expected a finite number, found {str(value)[:40]!r}")
    if not low <= value <= high:
        raise InputError(f"{place}: expected a number from {low:g} to {high:g}, found {value:g}")
    return float(value)
