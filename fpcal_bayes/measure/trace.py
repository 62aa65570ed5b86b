"""Recorded irradiance: along a sweep (a trace) and against the wavelength at rest (a scan), in memory and as CSV."""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError, located
from fpcal_bayes.files import read_text, require_line_end, write_text

Floats = NDArray[np.float64]

TRACE_COLUMNS = ("t_s", "joint", "irradiance_v")
SCAN_COLUMNS = ("wavelength_nm", "irradiance_v")

#: Samples of one file; a longer one is no sweep.
MAX_SAMPLES = 20_000_000

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True, eq=False)
class Trace:
    """The photodiode during one sweep.

    Attributes
    ----------
    time_s
        Increasing, shape (n,).
    joint
        Position of the joint that moves, in um or rad, shape (n,).
    irradiance
        In V, shape (n,).
    file
        Where it was read, or empty.
    """

    time_s: Floats
    joint: Floats
    irradiance: Floats
    file: str = ""

    def __len__(self) -> int:
        return len(self.irradiance)

    def __repr__(self) -> str:
        return f"Trace({len(self)} samples{f', {self.file}' if self.file else ''})"


@dataclass(frozen=True, eq=False)
class WavelengthScan:
    """The photodiode while the laser's wavelength is swept and the robot stands still.

    Attributes
    ----------
    wavelength
        In vacuum, in um, rising or falling throughout, shape (n,).
    irradiance
        In V, shape (n,).
    file
        Where it was read, or empty.
    """

    wavelength: Floats
    irradiance: Floats
    file: str = ""

    def __len__(self) -> int:
        return len(self.irradiance)

    def __repr__(self) -> str:
        return f"WavelengthScan({len(self)} samples{f', {self.file}' if self.file else ''})"


def read_trace(path: str | Path, scale: float) -> Trace:
    """Read a trace from a CSV file with the columns ``t_s,joint,irradiance_v``.

    Parameters
    ----------
    scale
        Internal units per shown unit of the joint: 1 for um, pi / 180 for deg.

    Raises
    ------
    InputError
        If the file is missing, holds anything but finite numbers, or time does not run forwards.
    """
    path = Path(path)
    table = _read_columns(path, TRACE_COLUMNS)
    trace = Trace(table[0], table[1] * scale, table[2], str(path))
    check_trace(trace, _line_of(path))
    return trace


def write_trace(path: str | Path, trace: Trace, scale: float) -> None:
    """Write a trace to a CSV file, whole or not at all; `read_trace` reads the same numbers back.

    A joint in rad that no number of degrees stands for is off by its last bit.

    Parameters
    ----------
    scale
        Internal units per shown unit of the joint.
    """
    _write_columns(Path(path), TRACE_COLUMNS, (trace.time_s, unscaled(trace.joint, scale), trace.irradiance))


def read_scan(path: str | Path) -> WavelengthScan:
    """Read a wavelength scan from a CSV file with the columns ``wavelength_nm,irradiance_v``.

    Raises
    ------
    InputError
        If the file is missing, holds anything but finite numbers, or the wavelength turns back.
    """
    path = Path(path)
    table = _read_columns(path, SCAN_COLUMNS)
    scan = WavelengthScan(table[0] * 1e-3, table[1], str(path))
    check_scan(scan, _line_of(path))
    return scan


def write_scan(path: str | Path, scan: WavelengthScan) -> None:
    """Write a wavelength scan to a CSV file, whole or not at all, to the last bit or the one before."""
    _write_columns(Path(path), SCAN_COLUMNS, (unscaled(scan.wavelength, 1e-3), scan.irradiance))


def check_trace(trace: Trace, line_of: "_LineOf | None" = None) -> None:
    """Raise `InputError` unless a trace holds finite numbers and its time runs forwards.

    Parameters
    ----------
    line_of
        Tells the line of a sample, for the message; by default its number, from 1.
    """
    columns = dict(zip(TRACE_COLUMNS, (trace.time_s, trace.joint, trace.irradiance), strict=True))
    _require_finite(trace.file or "trace", columns, line_of)
    back = np.diff(trace.time_s) <= 0
    if back.any():
        raise located(
            trace.file or "trace",
            f"expected a time later than the {trace.time_s[np.argmax(back)]:.10g} s before it",
            row=_line(line_of, int(np.argmax(back)) + 1),
            column="t_s",
        )


def check_scan(scan: WavelengthScan, line_of: "_LineOf | None" = None) -> None:
    """Raise `InputError` unless a scan holds finite numbers and its wavelength goes one way.

    Parameters
    ----------
    line_of
        Tells the line of a sample, for the message; by default its number, from 1.
    """
    file = scan.file or "scan"
    _require_finite(file, dict(zip(SCAN_COLUMNS, (scan.wavelength, scan.irradiance), strict=True)), line_of)
    low = scan.wavelength <= 0
    if low.any():
        raise located(
            file, "expected a wavelength above zero", row=_line(line_of, int(np.argmax(low))), column=SCAN_COLUMNS[0]
        )
    steps = np.diff(scan.wavelength)
    turned = steps * (scan.wavelength[-1] - scan.wavelength[0]) <= 0
    if turned.any():
        raise located(
            file,
            "expected wavelengths that only rise or only fall",
            row=_line(line_of, int(np.argmax(turned)) + 1),
            column=SCAN_COLUMNS[0],
        )


def unscaled(values: Floats, scale: float) -> Floats:
    """Numbers x with x * scale equal to `values` to the last bit wherever such numbers exist.

    A quotient alone is off by a bit now and then, and a file read back would differ from what was written.
    """
    shown = values / scale
    for towards in (-np.inf, np.inf):
        off = shown * scale != values
        if not off.any():
            break
        near = np.nextafter(values / scale, towards)
        shown = np.where(off & (near * scale == values), near, shown)
    return np.asarray(shown)


class _LineOf:
    """Line of a sample in a CSV file; the file is looked at again only when a message needs it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __call__(self, sample: int) -> int:
        filled = [number for number, line in enumerate(read_text(self.path).splitlines(), 1) if line.strip()]
        return filled[sample + 1]


def _line_of(path: Path) -> _LineOf:
    return _LineOf(path)


def _line(line_of: _LineOf | None, sample: int) -> int:
    return sample + 1 if line_of is None else line_of(sample)


def _require_finite(file: str, columns: dict[str, Floats], line_of: _LineOf | None) -> None:
    n = {name: values.shape for name, values in columns.items()}
    if len(set(n.values())) > 1 or any(len(shape) != 1 for shape in n.values()):
        raise InputError(f"{file}: expected columns of one length, found {n}")
    for name, values in columns.items():
        bad = ~np.isfinite(values)
        if bad.any():
            first = int(np.argmax(bad))
            found = f"expected a finite number, found {values[first]}"
            raise located(file, found, row=_line(line_of, first), column=name)
    if len(values) < 2:
        raise InputError(f"{file}: {len(values)} samples, expected two or more")


def _read_columns(path: Path, names: tuple[str, ...]) -> Floats:
    """The columns of a CSV file of numbers, shape (n_columns, n)."""
    text = read_text(path)
    head, _, body = text.lstrip("\r\n").partition("\n")
    if tuple(head.strip().split(",")) != names:
        raise located(path, f"expected the header {','.join(names)}", row=1)
    if not body.strip():
        raise InputError(f"{path}: no samples under the header")
    if body.count("\n") > MAX_SAMPLES:
        raise InputError(f"{path}: more than {MAX_SAMPLES} samples")
    lines = body.strip().replace("\r\n", "\n").encode()
    marks = np.frombuffer(lines, dtype=np.uint8)
    breaks = np.flatnonzero(marks == ord("\n"))
    commas = np.searchsorted(np.flatnonzero(marks == ord(",")), np.append(breaks, len(marks)))
    if (np.diff(commas, prepend=0) != len(names) - 1).any():
        # Blank lines are let through; everything else is a fault.
        filled = [line for line in lines.decode().split("\n") if line.strip()]
        if any(line.count(",") != len(names) - 1 for line in filled):
            raise _first_fault(path, text, names)
        lines = "\n".join(filled).encode()
    try:
        with warnings.catch_warnings():
            # The text reader warns, and stops, at what is not a number.
            warnings.simplefilter("error")
            table = np.fromstring(lines.replace(b"\n", b","), sep=",")
    except (DeprecationWarning, ValueError) as error:
        raise _first_fault(path, text, names) from error
    if len(table) % len(names) or not np.isfinite(table).all():
        raise _first_fault(path, text, names)
    require_line_end(path, text)
    return np.ascontiguousarray(table.reshape(-1, len(names)).T)


def _first_fault(path: Path, text: str, names: tuple[str, ...]) -> InputError:
    """The message for the first field that is no number, or the first line with too many or too few fields."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    for number, line in lines[1:]:
        fields = line.split(",")
        if len(fields) != len(names):
            return located(path, f"expected {len(names)} fields, found {len(fields)}", row=number)
        for name, field in zip(names, fields, strict=True):
            if not _NUMBER.fullmatch(field.strip()):
                found = f"found {field[:40]!r}" if field.strip() else "found nothing"
                return located(path, f"expected a number, {found}", row=number, column=name)
    return InputError(f"{path}: expected lines of {len(names)} numbers")


def _write_columns(path: Path, names: tuple[str, ...], columns: tuple[Floats, ...]) -> None:
    # repr gives the shortest text that reads back as the same number; adding zero turns -0 into 0.
    texts = [map(repr, (column + 0.0).tolist()) for column in columns]
    lines = "\n".join(map(",".join, zip(*texts, strict=True)))
    write_text(path, f"{','.join(names)}\n{lines}\n")
