"""Flat files of the current best estimate: JSON or MATLAB, with the functions that read them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from fpcal_bayes.core.files import replacing, require_suffix, write_json, write_text
from fpcal_bayes.core.resources import data_file

FUNCTIONS = ("fpcal_fk.m", "fpcal_ik.m")
FLAT_SUFFIXES = (".json", ".mat")


def write_flat(path: Path, content: Mapping[str, Any]) -> None:
    """Write flat names and values, None as null or NaN, and the MATLAB functions that read them where none are."""
    require_suffix(path, *FLAT_SUFFIXES)
    for name in FUNCTIONS:
        beside = path.parent / name
        if not beside.exists() and (path.is_file() or not path.exists()):
            write_text(beside, data_file(f"matlab/{name}").read_text(encoding="utf-8"))
    if path.suffix.lower() == ".json":
        write_json(path, dict(content))
        return
    table: dict[str, Any] = {}
    for name, value in content.items():
        array = np.array([np.nan if value is None else value]) if not isinstance(value, list) else np.array(value)
        if isinstance(value, str):
            table[name] = value
        elif array.dtype.kind == "U":
            table[name] = array.astype(object)[:, None]
        else:
            table[name] = array.astype(float)
    with replacing(path) as temporary, temporary.open("wb") as handle:
        scipy.io.savemat(handle, table, oned_as="column")
