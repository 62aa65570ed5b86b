"""Rows of a campaign from the readings of its traces and scans."""

from dataclasses import replace

import numpy as np

from fpcal_bayes.measure.fringes.reading import Reading
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.wavelength_scan import ScanReading


def sweep_rows(sweeps: Sweeps, row: int, reading: Reading, points: int = 0) -> Sweeps:
    """The rows of one sweep: its end, after `points` interior points that share a group with it.

    Parameters
    ----------
    sweeps, row
        The plan and the position in it.
    reading
        A good one.
    """
    one = sweeps.take(np.array([row]))
    if points == 0:
        one = one.with_measurement(np.array([reading.dl]), reading.sigma)
        return replace(one, signed=np.array([reading.signed]), group=np.array([""]))
    s, changes, sigma = reading.grouped(points)
    rows = one.take(np.zeros(points + 1, dtype=np.int64))
    label = str(one.label[0]) or f"row {one.rows[0]}"
    names = [f"{label}-mid"] if points == 1 else [f"{label}-{i}of{points + 1}" for i in range(1, points + 1)]
    share = (s[:, None] + 1.0) / 2.0
    q_end = rows.q_start + share * (rows.q_end - rows.q_start)
    q_end[-1] = one.q_end[0]
    if not reading.signed:
        changes = np.abs(changes)
    rows = replace(
        rows,
        q_end=q_end,
        label=np.array([*names, label], dtype=np.str_),
        group=np.array([label] * (points + 1), dtype=np.str_),
        signed=np.full(points + 1, reading.signed),
    )
    return rows.with_measurement(changes, sigma)


def absolute_rows(sweeps: Sweeps, row: int, before: ScanReading | None, after: ScanReading | None) -> Sweeps:
    """Absolute lengths at the start and at the end of a sweep, those of the two scans that are good."""
    one = sweeps.take(np.array([row]))
    here = one.q_start, one.q_end
    good = [(scan, q, name) for scan, q, name in zip((before, after), here, ("before", "after"), strict=True)]
    kept = [(scan, q, name) for scan, q, name in good if scan is not None and scan.good]
    rows = one.take(np.zeros(len(kept), dtype=np.int64))
    if not kept:
        return rows
    apart = one.kind[0] != "absolute"
    rows = replace(
        rows,
        q_start=np.concatenate([q for _, q, _ in kept]),
        q_end=np.concatenate([q for _, q, _ in kept]),
        label=np.array([f"{one.label[0]}-{name}" if apart else str(one.label[0]) for *_, name in kept], dtype=np.str_),
        kind=np.full(len(kept), "absolute"),
        group=np.full(len(kept), "", dtype=np.str_),
        signed=np.ones(len(kept), dtype=bool),
        trace=np.full(len(kept), "", dtype=np.str_),
    )
    lengths, sigmas = (np.array([getattr(scan, name) for scan, *_ in kept]) for name in ("length", "sigma"))
    return rows.with_measurement(lengths, sigmas)
