"""Recorded sweeps in memory: what moved, with the trace, the wavelength scans and the air of each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.traces import Trace, WavelengthScan, check_scan, check_trace, plausible_wavelength
from fpcal_bayes.model.cell.cell import Cell


@dataclass(frozen=True, eq=False)
class TraceIndex:
    """Recorded sweeps, row by row."""

    sweeps: Sweeps  # A plan: what moved from where to where. The temperature of the air stands in `temperature_c` below
    wavelength: Floats  # of the laser in vacuum, in um; NaN: the cell's, shape (n,)
    #: temperature_c, pressure_hpa, humidity_pct: Of the air; NaN: unknown, shape (n,).
    temperature_c: Floats
    pressure_hpa: Floats
    humidity_pct: Floats
    traces: list[Trace]  # one per row; without samples in rows of kind ``absolute``, whose length is in `scans_after`
    #: scans_before, scans_after: Wavelength scans at the start and at the end of each row, or None.
    scans_before: list[WavelengthScan | None]
    scans_after: list[WavelengthScan | None]

    @classmethod
    def of(cls, sweeps: Sweeps, traces: list[Trace]) -> "TraceIndex":
        """Traces of `sweeps` with the cell's wavelength, unknown air, and no scans."""
        unknown = np.full(len(sweeps), np.nan)
        none: list[WavelengthScan | None] = [None] * len(sweeps)
        return cls(sweeps, unknown, unknown, unknown, unknown, traces, none, list(none))

    def __len__(self) -> int:
        return len(self.sweeps)

    def take(self, rows: NDArray[np.int64]) -> "TraceIndex":
        """Some rows."""
        numbers = (self.wavelength, self.temperature_c, self.pressure_hpa, self.humidity_pct)
        wavelength, temperature_c, pressure_hpa, humidity_pct = (each[rows] for each in numbers)
        before, after = ([each[i] for i in rows] for each in (self.scans_before, self.scans_after))
        traces = [self.traces[i] for i in rows]
        sweeps = self.sweeps.take(rows)
        return TraceIndex(sweeps, wavelength, temperature_c, pressure_hpa, humidity_pct, traces, before, after)

    def __repr__(self) -> str:
        return f"TraceIndex({counted(len(self), 'row')}, {sum(map(len, self.traces))} samples)"


def moving_joint(sweeps: Sweeps, row: int) -> int:
    """Position of the joint whose readings stand in a row's trace: the first that moves, or 0 where none does."""
    return int(np.argmax(sweeps.q_start[row] != sweeps.q_end[row]))


def no_trace() -> Trace:
    """The trace of a row that has none."""
    return Trace(np.zeros(0), np.zeros(0), np.zeros(0))


def check_index(index: TraceIndex, cell: Cell) -> None:
    """Hold an index to its rules."""
    sweeps = index.sweeps
    check_sweeps(sweeps, cell)
    parts = (index.wavelength, index.temperature_c, index.pressure_hpa, index.humidity_pct)
    if any(len(part) != len(sweeps) for part in (*parts, index.traces, index.scans_before, index.scans_after)):
        raise InputError(f"{sweeps.file}: expected {len(sweeps)} values of each part of the index")

    def refuse(bad: NDArray[np.bool_], column: str, expected: str) -> None:
        if bad.any():
            raise located(sweeps.file, expected, row=int(sweeps.rows[np.argmax(bad)]), column=column)

    light = ~np.isnan(index.wavelength) & ~plausible_wavelength(index.wavelength)
    refuse(light, "wavelength_nm", "expected a wavelength in nm, 200 to 20000")
    refuse(~np.isnan(index.temperature_c) & ~(abs(index.temperature_c) < 200), "temperature_c", "expected -200 to 200")
    refuse(
        ~np.isnan(index.pressure_hpa) & ~((index.pressure_hpa > 0) & (index.pressure_hpa < 1e4)),
        "pressure_hpa",
        "expected 0 to 10000",
    )
    humid = (index.humidity_pct >= 0) & (index.humidity_pct <= 100)
    refuse(~np.isnan(index.humidity_pct) & ~humid, "humidity_pct", "expected 0 to 100")
    for i, trace in enumerate(index.traces):
        row, name = int(sweeps.rows[i]), str(sweeps.label[i])
        if sweeps.kind[i] == "absolute":
            if index.scans_after[i] is None:
                raise located(sweeps.file, f"{name!r}: an absolute length needs a scan", row=row, column="scan_after")
        elif len(trace) == 0:
            raise located(sweeps.file, f"{name!r}: expected the file of a trace, found none", row=row, column="trace")
        else:
            check_trace(trace)
        for scan in (index.scans_before[i], index.scans_after[i]):
            if scan is not None:
                check_scan(scan)
