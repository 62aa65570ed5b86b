"""What is wrong or weak in a campaign, finding by finding, each with what to do about it."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from fpcal_bayes.analysis.doctor_fit import Finding, Severity, session_fits
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chi2_tail, counted
from fpcal_bayes.core.typing import Bools
from fpcal_bayes.infer.observability.observe import observe
from fpcal_bayes.measure.sweeps import Sweeps, repeated_rows
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.tracking.drift import HOURS_PER_DAY
from fpcal_bayes.tracking.sessions import check_sessions

_MOST_NAMED = 6
#: Share of a joint's range within which a pose counts as standing at its limit.
_AT_LIMIT = 0.01
#: Repeated sweeps that tell the noise, at least.
_LEAST_REPEATS = 4


def doctor(sweeps: Sweeps, cell: Cell) -> list[Finding]:
    """What there is to say of the sweeps of all sessions, measured or planned; problems first."""
    found = [*_times(sweeps), *_rows(sweeps, cell)]
    if sweeps.measured:
        found += [*_repeats(sweeps, cell), *session_fits(sweeps, cell)]
    else:
        found += _plan(sweeps, cell)
    ranks: dict[Severity, int] = {"problem": 0, "doubt": 1, "note": 2}
    return sorted(found, key=lambda finding: ranks[finding.severity])


def named(names: Sequence[str]) -> str:
    """Names in a row, the first few of them."""
    return ", ".join(names[:_MOST_NAMED]) + (f" and {len(names) - _MOST_NAMED} more" if names[_MOST_NAMED:] else "")


def row_names(sweeps: Sweeps, chosen: Bools) -> str:
    """Labels of some rows, or their lines where they have no label."""
    return named([str(sweeps.label[i]) or f"row {sweeps.rows[i]}" for i in np.flatnonzero(chosen)])


def _times(sweeps: Sweeps) -> Iterator[Finding]:
    names = sweeps.sessions
    times = {name: sweeps.time_h[sweeps.session == name] for name in names}
    if len(names) > 1 and len({float(t.max()) for t in times.values()}) == 1:
        what = f"all {len(names)} sessions stand at the same time, {sweeps.time_h[0]:g} h"
        remedy = "write the hours since the first session into time_h: drift cannot be followed without them"
        yield Finding("problem", "times", "", what, remedy)
    elif sweeps.measured:
        try:
            check_sessions(sweeps, now_h=None)
        except InputError as error:
            yield Finding(
                "problem", "sessions", "", str(error),
                "correct time_h, or give the rows of each session one name of their own; fpcal track refuses the file",
            )  # fmt: skip
    clocks = sweeps.utc != ""
    if clocks.any() and not clocks.all():
        what = f"{int((~clocks).sum())} of {len(sweeps)} rows have no clock time (utc)"
        yield Finding("doubt", "clock", "", what, "give every session's last row a utc, or none")
    known = ~np.isnan(sweeps.temperature_c)
    if known.any() and not known.all():
        what = f"{int((~known).sum())} of {len(sweeps)} rows have no temperature"
        remedy = "log it for every session if the cell's drift depends on it; sessions without it count as unchanged"
        yield Finding("note", "temperature", "", what, remedy)
    for before, after in pairwise(names):
        gap = float(times[after].min() - times[before].max())
        if gap > 7 * HOURS_PER_DAY:
            what = f"{gap / HOURS_PER_DAY:.1f} days without a measurement before it"
            remedy = "expect a wide prediction; a full calibration is safer than a few sweeps"
            yield Finding("note", "gap", after, what, remedy)


def _rows(sweeps: Sweeps, cell: Cell) -> Iterator[Finding]:
    unsigned = ~sweeps.signed & ~sweeps.absolute
    if unsigned.any():
        what = f"{int(unsigned.sum())} of {len(sweeps)} rows have no sign: {row_names(sweeps, unsigned)}"
        remedy = "none is needed if the fit decides them all; a wavelength scan before and after a sweep gives the sign"
        yield Finding("note", "unsigned", "", what, remedy)
    for name in sweeps.sessions:
        part = sweeps.of_session(name)
        again = repeated_rows(part)
        if part.measured and again.any():
            what = f"rows measured twice to the last digit: {row_names(part, again)}"
            remedy = "delete the copies: a reading that counts twice makes the result look better than it is"
            yield Finding("problem", "duplicates", name, what, remedy)
    moved = (sweeps.q_start != sweeps.q_end).any(axis=0)
    joints = [column.split("_")[0] for column in cell.joint_columns]
    still = [joint for joint, moves in zip(joints, moved, strict=True) if not moves]
    if still:
        what = f"no sweep moves {named(still)}"
        yield Finding("doubt", "still", "", what, "add sweeps of these joints: their parameters stay at the prior")
    reach = np.vstack([sweeps.q_start, sweeps.q_end])
    bounded = np.isfinite(cell.high - cell.low)
    low, high = np.where(bounded, cell.low, -1e300), np.where(bounded, cell.high, 1e300)
    margin = np.where(bounded, _AT_LIMIT * (high - low), 0.0)
    close = (reach > high - margin) | (reach < low + margin)
    at = [joint for joint, near in zip(joints, close.any(axis=0), strict=True) if near]
    if at:
        remedy = "see that the stage reached them: one that saturates reports a pose that it does not have"
        yield Finding("note", "limits", "", f"poses stand at the limit of {named(at)}", remedy)


def _repeats(sweeps: Sweeps, cell: Cell) -> Iterator[Finding]:
    """The noise that sweeps measured more than once show, against the stated one."""
    for name in sweeps.sessions:
        part = sweeps.of_session(name)
        part = part.take((part.kind == "sweep") & part.signed & (part.group == ""))
        places: dict[tuple[float, ...], list[int]] = {}
        beam = cell.beam_numbers(part.beam)
        for i, key in enumerate(map(tuple, np.column_stack([part.q_start, part.q_end, beam]).tolist())):
            places.setdefault(key, []).append(i)
        squares, free = 0.0, 0
        for rows in places.values():
            weighed = part.dl[rows] / part.sigma[rows]
            if len(set(part.dl[rows].tolist())) == len(rows) > 1:
                squares += float(((weighed - weighed.mean()) ** 2).sum())
                free += len(rows) - 1
        if free >= _LEAST_REPEATS and chi2_tail(squares, free) < 1e-3:
            yield Finding(
                "problem" if cell.mechanics is None else "doubt", "return", name,
                f"sweeps driven again differ {np.sqrt(squares / free):.1f} times as much as sigma_um says",
                "see that return_nm and return_urad of the joints that move cover it; sigma_um is for what readings "
                "show that are repeated without any motion",
            )  # fmt: skip
        yield from _still_readings(name, sweeps.of_session(name))
    wide = sweeps.sigma > 0.5 * cell.wavelength / 4
    if wide.any():
        what = f"{counted(int(wide.sum()), 'row')} with a sigma_um above an eighth of a wavelength"
        remedy = "read the fraction of the fringe, not whole fringes only: fpcal ingest does"
        yield Finding("doubt", "sigma", "", what, remedy)
    fine = sweeps.sigma < 1e-5
    if fine.any():
        what = f"{counted(int(fine.sum()), 'row')} with a sigma_um below 0.01 nm"
        yield Finding("doubt", "sigma", "", what, "check the unit: sigma_um is in um")


def _still_readings(name: str, part: Sweeps) -> Iterator[Finding]:
    """The noise that readings repeated without motion show: neighbours of one group at one pose."""
    part = part.take(np.argsort(part.beam, kind="stable"))
    again = (
        (part.group[1:] == part.group[:-1]) & (part.group[1:] != "") & (part.q_end[1:] == part.q_end[:-1]).all(axis=1)
    )
    again |= (part.absolute[1:] & part.absolute[:-1]) & (part.q_end[1:] == part.q_end[:-1]).all(axis=1)
    again &= part.signed[1:] & part.signed[:-1] & (part.beam[1:] == part.beam[:-1])
    # Both rows share the reading at their start, so that their difference has the variance of one.
    sd = np.where(part.absolute[1:], np.sqrt(2.0), 1.0) * part.sigma[1:]
    squares, free = float(((np.diff(part.dl) / sd)[again] ** 2).sum()), int(again.sum())
    if part.measured and free >= _LEAST_REPEATS and chi2_tail(squares, free) < 1e-3:
        what = f"readings repeated without motion differ {np.sqrt(squares / free):.1f} times as much as sigma_um says"
        yield Finding("problem", "sigma", name, what, "raise sigma_um by this factor")


def _plan(sweeps: Sweeps, cell: Cell) -> Iterator[Finding]:
    what = "the file is a plan: nothing is measured yet"
    yield Finding("note", "plan", "", what, "measure it; fpcal observe says in full what it will tell")
    for name in sweeps.sessions:
        for gauge in observe(cell, sweeps.of_session(name)).gauges:
            if gauge.layer != "model":
                yield Finding("doubt", "rank", name, gauge.explanation, gauge.remedy)
