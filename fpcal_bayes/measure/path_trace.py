"""The photodiode along a path of several joints, with the reference scans that go before and after it.

In a file: CSV with the columns ``part,t_s`` and the joints, ``q1_um`` .. ``q6_deg``, then ``irradiance_v``. Lines whose
part is ``reference`` come first: one joint moves through a few fringes, which tells the height of the fringes and where
on a fringe the path starts. Lines whose part is ``path`` follow. A second reference scan may come after them; it tells
how gain and offset drifted meanwhile.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError, located
from fpcal_bayes.files import write_text
from fpcal_bayes.measure.sweep_csv import column_numbers, read_records
from fpcal_bayes.model.cell import Cell, check_joints

Floats = NDArray[np.float64]

PARTS = ("reference", "path")
#: Samples of either part that a check needs.
FEWEST = 8


@dataclass(frozen=True, eq=False)
class PathTrace:
    """A recorded path.

    Attributes
    ----------
    time_s
        Increasing, shape (n,).
    q
        Joint vectors, shape (n, n_joints), in um and rad.
    irradiance
        In V, shape (n,).
    reference
        Whether a sample belongs to a reference scan, shape (n,); the others to the path, all in one piece.
    time_h
        Hours since the campaign began.
    file
        Where it was read, or empty.
    length
        True cavity length of a simulated recording, in um, shape (n,); else None.
    """

    time_s: Floats
    q: Floats
    irradiance: Floats
    reference: NDArray[np.bool_]
    time_h: float = 0.0
    file: str = ""
    length: Floats | None = None

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


def path_columns(cell: Cell) -> tuple[str, ...]:
    """Names of the columns of a path's file."""
    return ("part", "t_s", *cell.joint_columns, "irradiance_v")


def write_path_trace(path: str | Path, trace: PathTrace, cell: Cell) -> None:
    """Write a recorded path, whole or not at all."""
    shown = trace.q / cell.joint_scales
    numbers = np.column_stack([trace.time_s, shown, trace.irradiance]) + 0.0
    parts = np.where(trace.reference, *PARTS).tolist()
    lines = [",".join([part, *(f"{x:.13g}" for x in row)]) for part, row in zip(parts, numbers.tolist(), strict=True)]
    write_text(Path(path), "\n".join([",".join(path_columns(cell)), *lines]) + "\n")


def read_path_trace(path: str | Path, cell: Cell) -> PathTrace:
    """Read a recorded path.

    Raises
    ------
    InputError
        If the file is not as documented, a joint leaves its limits, time runs backwards, the path is not in one piece
        after a reference scan, or a part has fewer than 8 samples.
    """
    path = Path(path)
    columns = path_columns(cell)
    records, lines = read_records(path)
    if not records or tuple(records[0]) != columns:
        raise located(path, f"expected the header {','.join(columns)}", row=lines[0] if lines else 1)
    rows = lines[1:]
    for record, row in zip(records[1:], rows, strict=True):
        if len(record) != len(columns):
            raise located(path, f"expected {len(columns)} fields, found {len(record)}", row=row)
        if record[0] not in PARTS:
            raise located(path, f"expected {' or '.join(PARTS)}, found {record[0][:40]!r}", row=row, column="part")
    fields = list(zip(*records[1:], strict=True)) or [()] * len(columns)
    numbers = [
        column_numbers(cells, np.array(rows, dtype=np.int64), path, name)
        for name, cells in zip(columns[1:], fields[1:], strict=True)
    ]
    reference = np.array([part == PARTS[0] for part in fields[0]], dtype=bool)
    q = np.column_stack(numbers[1:-1]) * cell.joint_scales
    trace = PathTrace(numbers[0], q, numbers[-1], reference, file=str(path))
    for name, values in zip(columns[1:], numbers, strict=True):
        if not np.isfinite(values).all():
            raise located(path, "expected a finite number", row=rows[int(np.argmin(np.isfinite(values)))], column=name)
    check_joints(cell, trace.q, path, rows, cell.joint_columns)
    back = np.diff(trace.time_s) <= 0
    if back.any():
        row = rows[int(np.argmax(back)) + 1]
        raise located(path, "expected a later time than in the line before", row=row, column="t_s")
    check_parts(trace, rows)
    return trace


def check_parts(trace: PathTrace, rows: list[int] | None = None) -> None:
    """Hold a recording to the order of its parts and to samples enough in each.

    Parameters
    ----------
    rows
        Line of each sample, for the message; by default its number, from 1.

    Raises
    ------
    InputError
        If the path is not in one piece after a reference scan, or a part has fewer than 8 samples.
    """
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
