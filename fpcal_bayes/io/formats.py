"""Files that other programs write: columns by name from text with header lines, from LabVIEW TDMS, and from MATLAB.

Text may have any lines before its numbers, tabs, semicolons, commas or blanks between them, and decimal commas: what
oscilloscopes, LabVIEW (LVM) and PI's GCS arrays write. What a file is, its content tells.
"""

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import require_line_end, require_readable
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import MAX_SAMPLES
from fpcal_bayes.io.hdf5 import is_hdf5
from fpcal_bayes.io.recordings_mat import load_variables

_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?")
#: What stands between two numbers; None: blanks.
_DELIMITERS = ("\t", ";", ",", None)
#: A GCS array names its columns and its interval of time in lines of their own.
_GCS_NAME, _GCS_STEP = re.compile(r"#\s*NAME(\d+)\s*=\s*(.+)"), re.compile(r"#\s*SAMPLE_TIME\s*=\s*(\S+)")
#: Names shown of a file that has others than expected.
_SHOWN = 8


def is_other(path: Path, head: str) -> bool:
    """Whether a file is none of the project's own, whose first line is `head`."""
    require_readable(path)
    with path.open("rb") as file:
        return file.readline(4096).decode("utf-8-sig", "replace").strip() != head


def read_named(path: Path, names: Sequence[str], columns: Mapping[str, str]) -> Floats:
    """Columns (n_columns, n) by their names, or by what `columns` says; a number for the time is the interval in s."""
    with path.open("rb") as file:
        start = file.read(128)
    wanted = [columns.get(name, name) for name in names]
    if start.startswith(b"TDSm"):
        return _picked(path, names, wanted, _tdms(path))
    if start.startswith(b"MATLAB 5.0") or b"MATLAB 7.3" in start or is_hdf5(path):
        arrays = {name: np.asarray(value) for name, value in load_variables(path).items() if name[:2] != "__"}
        numbers = {name: array.astype(float).ravel() for name, array in arrays.items() if array.dtype.kind in "fiu"}
        return _picked(path, names, wanted, numbers)
    return _text(path, names, wanted)


def _picked(
    path: Path, names: Sequence[str], wanted: Sequence[str], found: Mapping[str, Floats], row: int = 0
) -> Floats:
    """The wanted columns of those that were found, the first of them the time."""
    chosen: list[Floats] = []
    for name, text in zip(names, wanted, strict=True):
        same = _same(text, found)
        step = float(text) if _NUMBER.fullmatch(text) and "," not in text else 0.0
        if len(same) == 1:
            chosen.append(found[same[0]])
        elif step > 0.0 and name == names[0]:
            chosen.append(np.asarray(step * np.arange(len(next(iter(found.values()), ()))), dtype=float))
        else:
            known = ", ".join(repr(key) for key in list(found)[:_SHOWN]) + (", ..." if len(found) > _SHOWN else "")
            what = f"expected the header {','.join(names)}, found {known or 'no columns'}"
            keys = ",".join(f"{key.split('_')[0]}=NAME" for key in names)
            raise located(path, f"{what}: name its columns, --columns {keys}", row=row or None)
    if len({len(column) for column in chosen}) > 1:
        raise InputError(f"{path}: expected columns of one length, found {', '.join(str(len(c)) for c in chosen)}")
    if not len(chosen[0]):
        raise InputError(f"{path}: no samples under the header")
    if not np.isfinite(chosen).all():
        raise InputError(f"{path}: expected finite numbers in {', '.join(wanted)}")
    return np.ascontiguousarray(chosen, dtype=float)


def _same(text: str, names: Iterable[str]) -> list[str]:
    """Names that a text may stand for: "Time" for "Time (s)" too, and a channel for itself in its group."""
    exact = [name for name in names if name.casefold() == text.casefold()]
    loose = re.compile(rf"(.*/)?{re.escape(text)}\W.*|.*/{re.escape(text)}", re.IGNORECASE)
    return exact or [name for name in names if loose.fullmatch(name)]


def _tdms(path: Path) -> dict[str, Floats]:
    """Channels of a LabVIEW file as group/channel, with the time of a waveform as group/channel time."""
    try:
        import nptdms
    except ImportError:
        raise InputError(f"{path}: a TDMS file, read by npTDMS: pip install 'fpcal-bayes[formats]'") from None
    try:
        channels = [channel for group in nptdms.TdmsFile.read(path).groups() for channel in group.channels()]
        numeric = [each for each in channels if each.dtype is not None and np.dtype(each.dtype).kind in "fiu"]
        found = {f"{each.group_name}/{each.name}": np.asarray(each[:], dtype=float) for each in numeric}
        for each in numeric:
            if "wf_increment" in each.properties:
                found[f"{each.group_name}/{each.name} time"] = np.asarray(each.time_track(), dtype=float)
    except Exception as error:  # npTDMS raises whatever a damaged file leads to
        raise InputError(f"{path}: a damaged TDMS file, expected one that can be read ({str(error)[:100]})") from None
    return found


def _text(path: Path, names: Sequence[str], wanted: Sequence[str]) -> Floats:
    """Columns of a text with header lines; the last line of numbers tells what stands between them."""
    text = path.read_bytes().decode("utf-8-sig", "replace")
    lines = text.splitlines()
    filled = [i for i, line in enumerate(lines) if line.strip()]
    if len(filled) > MAX_SAMPLES:
        raise InputError(f"{path}: more than {MAX_SAMPLES} samples")
    last = lines[filled[-1]] if filled else ""
    splits = [d for d in _DELIMITERS if len(fields := _fields(last, d)) > 1 and all(map(_NUMBER.fullmatch, fields))]
    if not splits:
        at = filled[0] if filled else 0
        found = f"found {lines[at][:60]!r}" if filled else "found no text"
        raise located(path, f"expected the header {','.join(names)}, {found}", row=at + 1)
    delimiter, first = splits[0], filled[-1]
    # From the last line upwards, as long as there are numbers.
    for i in reversed(filled):
        if not all(map(_NUMBER.fullmatch, _fields(lines[i], delimiter))):
            break
        first = i
    titles = [i for i in filled if i < first]
    head = {int(m[1]): m[2].strip() for i in titles if (m := _GCS_NAME.match(lines[i]))}
    step = next((m[1] for i in titles if (m := _GCS_STEP.match(lines[i]))), "")
    # A line of units may stand between names and numbers: the header is the line with most of the wanted names.
    titles.sort(key=lambda i: (sum(len(_same(name, _names(lines[i], delimiter))) == 1 for name in wanted), i))
    row = titles[-1] + 1 if titles else 1
    header = [head[i] for i in sorted(head)] if head else _names(lines[row - 1], delimiter) if titles else []
    if step and not _same(wanted[0], header):
        wanted = [step, *wanted[1:]]
    body = "\n".join(lines[i] for i in filled if i >= first)
    if delimiter != ",":
        body = body.replace(",", ".")
    width = len(_fields(lines[first], delimiter))
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=delimiter, usecols=range(width), ndmin=2)
    except ValueError:
        bad = next(i for i in filled if i >= first and len(_fields(lines[i], delimiter)) != width)
        wrong = f"expected {width} fields, found {len(_fields(lines[bad], delimiter))}"
        raise located(path, wrong, row=bad + 1) from None
    require_line_end(path, text)
    return _picked(path, names, wanted, dict(zip(header, table.T, strict=False)), row)


def _names(line: str, delimiter: str | None) -> list[str]:
    return [field.strip().strip('"') for field in line.lstrip("#% ").split(delimiter)]


def _fields(line: str, delimiter: str | None) -> list[str]:
    fields = [field.strip() for field in line.split(delimiter)]
    return fields[:-1] if fields and not fields[-1] else fields
