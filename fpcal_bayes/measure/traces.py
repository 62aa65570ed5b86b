"""What the photodiode recorded: traces along sweeps, wavelength scans at rest, and paths of several joints.

A path goes with the reference scans around it: in the first, one joint moves through a few fringes, which tells the
height of the fringes and where on a fringe the path starts. A second one may come after the path; it tells how gain
and offset drifted meanwhile.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, largest, located
from fpcal_bayes.core.typing import Floats

#: Tells the line of a sample in its file.
LineOf = Callable[[int], int]

TRACE_COLUMNS = ("t_s", "joint", "irradiance_v")
SCAN_COLUMNS = ("wavelength_nm", "irradiance_v")
PARTS = ("reference", "path")
#: Samples of either part that a check needs.
FEWEST = 8


@dataclass(frozen=True, eq=False)
class Trace:
    """The photodiode during one sweep."""

    time_s: Floats  # increasing, shape (n,)
    joint: Floats  # position of the joint that moves, in um or rad, shape (n,)
    irradiance: Floats  # in V, shape (n,)
    file: str = ""  # where it was read, or empty

    def __len__(self) -> int:
        return len(self.irradiance)

    def __repr__(self) -> str:
        return f"Trace({len(self)} samples{f', {self.file}' if self.file else ''})"


@dataclass(frozen=True, eq=False)
class WavelengthScan:
    """The photodiode while the laser's wavelength is swept and the robot stands still."""

    wavelength: Floats  # in vacuum, in um, rising or falling throughout, shape (n,)
    irradiance: Floats  # in V, shape (n,)
    file: str = ""  # where it was read, or empty

    def __len__(self) -> int:
        return len(self.irradiance)

    def __repr__(self) -> str:
        return f"WavelengthScan({len(self)} samples{f', {self.file}' if self.file else ''})"


def check_trace(trace: Trace, line_of: LineOf | None = None) -> None:
    """Raise `InputError` unless a trace holds finite numbers and its time runs forwards; `line_of`: its lines."""
    columns = dict(zip(TRACE_COLUMNS, (trace.time_s, trace.joint, trace.irradiance), strict=True))
    _require_finite(trace.file or "trace", columns, line_of)
    back = np.diff(trace.time_s, prepend=-np.inf) <= 0
    before = trace.time_s[np.argmax(back) - 1]
    _refuse(trace.file or "trace", back, "t_s", f"expected a time later than the {before:.10g} s before it", line_of)


def plausible_wavelength(wavelength: Floats) -> NDArray[np.bool_]:
    """Whether wavelengths in um (n,) are those of a laser that an interferometer is built with."""
    return np.asarray((wavelength >= 0.2) & (wavelength <= 20.0))


def check_scan(scan: WavelengthScan, line_of: LineOf | None = None) -> None:
    """Raise `InputError` unless a scan holds finite numbers and its wavelength goes one way; `line_of`: its lines."""
    file = scan.file or "scan"
    _require_finite(file, dict(zip(SCAN_COLUMNS, (scan.wavelength, scan.irradiance), strict=True)), line_of)
    wrong, column = ~plausible_wavelength(scan.wavelength), SCAN_COLUMNS[0]
    _refuse(file, wrong, column, "expected a wavelength in nm, 200 to 20000", line_of)
    turned = np.append(False, np.diff(scan.wavelength) * (scan.wavelength[-1] - scan.wavelength[0]) <= 0)
    _refuse(file, turned, column, "expected wavelengths that only rise or only fall", line_of)


def _refuse(file: str, bad: NDArray[np.bool_], column: str, expected: str, line_of: LineOf | None) -> None:
    if bad.any():
        first = int(np.argmax(bad))
        raise located(file, expected, row=first + 1 if line_of is None else line_of(first), column=column)


def _require_finite(file: str, columns: dict[str, Floats], line_of: LineOf | None) -> None:
    n = {name: values.shape for name, values in columns.items()}
    if len(set(n.values())) > 1 or any(len(shape) != 1 for shape in n.values()):
        raise InputError(f"{file}: expected columns of one length, found {n}")
    for name, values in columns.items():
        bad = ~(np.abs(values) <= largest(name))
        if bad.any():
            found = f"expected a finite number up to {largest(name):g}, found {values[np.argmax(bad)]:g}"
            _refuse(file, bad, name, found, line_of)
    if len(values) < 2:
        raise InputError(f"{file}: {len(values)} samples, expected two or more")


@dataclass(frozen=True, eq=False)
class PathTrace:
    """A recorded path."""

    time_s: Floats  # increasing, shape (n,)
    q: Floats  # joint vectors, shape (n, n_joints), in um and rad
    irradiance: Floats  # in V, shape (n,)
    #: Whether a sample belongs to a reference scan, shape (n,); the others to the path, all in one piece.
    reference: NDArray[np.bool_]
    time_h: float = 0.0  # hours since the campaign began
    file: str = ""  # where it was read, or empty
    length: Floats | None = None  # true cavity length of a simulated recording, in um, shape (n,); else None

    def __len__(self) -> int:
        return len(self.irradiance)

    def __repr__(self) -> str:
        return f"PathTrace({int(self.reference.sum())} samples of reference, {int((~self.reference).sum())} of path)"

    @property
    def before(self) -> slice:
        """The samples of the reference scan before the path."""
        return slice(0, int(np.argmin(self.reference)))

    @property
    def path(self) -> slice:
        """The samples of the path."""
        return slice(int(np.argmin(self.reference)), len(self) - int(np.argmin(self.reference[::-1])))

    @property
    def after(self) -> slice:
        """The samples of the reference scan after the path; there may be none."""
        return slice(self.path.stop, len(self))

    @property
    def length_change(self) -> float:
        """True peak to peak of the cavity length along the path, in um; NaN if it is not known."""
        return float("nan") if self.length is None else float(np.ptp(self.length[~self.reference]))


def check_parts(trace: PathTrace, rows: list[int] | None = None) -> None:
    """Hold a recording to the order of its parts and to samples enough in each; `rows`: its lines."""
    file, back = trace.file or "recording", np.flatnonzero(np.diff(trace.reference.astype(int)) < 0)
    if not trace.reference[:1].any():
        raise located(file, "expected a reference scan before the path", row=rows[0] if rows else 1, column="part")
    if len(back) > 1:
        sample = int(back[1]) + 1
        raise located(file, "expected the path in one piece", row=rows[sample] if rows else sample + 1, column="part")
    counts = {"reference": trace.before, "path": trace.path, "second reference": trace.after}
    if not len(back):
        raise InputError(f"{file}: no samples of part path, expected {FEWEST} or more")
    for part, members in counts.items():
        n = members.stop - members.start
        if n < FEWEST and not (part == "second reference" and n == 0):
            raise InputError(f"{file}: {n} samples of the {part}, expected {FEWEST} or more")
