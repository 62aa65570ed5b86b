"""Flat files of the current best estimate: JSON or MATLAB, with the functions that read them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fpcal_bayes.core.files import require_suffix, write_json, write_text
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.recordings_mat import write_mat

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
    else:
        write_mat(path, content)
