"""The sessions of a campaign in order of time, held to the rules of a history."""

from datetime import UTC, datetime
from itertools import pairwise

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import content_sha256
from fpcal_bayes.core.times import clock, iso, read_time
from fpcal_bayes.measure.sweeps import Sweeps, join, repeated_rows

#: How far a clock may be ahead of this machine's.
_CLOCK_SLACK_H = 0.1
#: How far clock times and hours may part: less than summer time anywhere.
_CLOCK_STEP_H = 0.4
#: What a row says, beside its temperature.
_SAID = ("time_h", "q_start", "q_end", "dl", "sigma", "signed", "group", "kind")
#: Units that hours are mistaken for, as so many in an hour.
_UNITS = {"minutes": 60.0, "seconds": 3600.0, "days": 1.0 / 24.0}


def check_sessions(sweeps: Sweeps, now_h: float | None = None) -> list[Sweeps]:
    """The sweeps of each session, in order of time; `InputError` where they break the rules of a history."""
    if not sweeps.measured:
        raise InputError(f"{sweeps.file}: expected measured sweeps, with dl_um and sigma_um")
    parts = [sweeps.take(sweeps.session == name) for name in sweeps.sessions]
    for before, after in pairwise(parts):
        end, begin = float(before.time_h.max()), float(after.time_h.min())
        if begin < end:
            text = (
                f"begins at {begin:g} h before session {before.session[0]!s} ends at {end:g} h, expected sessions one "
                "after the other"
            )
            raise _refusal(after, np.argmin(after.time_h), text, "time_h")
    _check_clocks(parts)
    _refuse_duplicates(parts)
    _refuse_future(parts, now_h)
    return parts


def session_sha256(sweeps: Sweeps) -> str:
    """Hash of everything that a session's rows say."""
    said = [getattr(sweeps, name).tolist() for name in _SAID]
    return content_sha256([*said, ["" if np.isnan(t) else t for t in sweeps.temperature_c.tolist()]])


def mean_temperature(sweeps: Sweeps) -> float:
    """Mean of the logged temperatures in degrees Celsius, or NaN."""
    logged = sweeps.temperature_c[~np.isnan(sweeps.temperature_c)]
    return float(logged.mean()) if len(logged) else float("nan")


def hours_of(text: str, sweeps: Sweeps) -> float:
    """A user's time, hours or clock time, in hours of the campaign; `InputError` if no session has a clock."""
    wanted = read_time(text)
    if isinstance(wanted, float):
        return wanted
    row = np.flatnonzero(sweeps.utc != "")
    if not len(row):
        raise InputError(f"{sweeps.file}: no row carries utc: expected the time {text[:40]!r} in hours")
    return float(sweeps.time_h[row[0]]) + (wanted - clock(str(sweeps.utc[row[0]]))).total_seconds() / 3600.0


def hours_at(moment: float, sweeps: Sweeps) -> float | None:
    """A Unix time in hours since the campaign began; None where no row carries a clock time."""
    return hours_of(iso(moment), sweeps) if (sweeps.utc != "").any() else None


def hours_now(sweeps: Sweeps, otherwise: float) -> float:
    """The clock of this machine in hours since the campaign began, or `otherwise` if no row carries a clock time."""
    if not (sweeps.utc != "").any():
        return otherwise
    # Within the slack of clocks the last session may seem to lie ahead.
    return max(otherwise, hours_of(datetime.now(UTC).isoformat(), sweeps))


def _refusal(part: Sweeps, row: int | np.int64, text: str, column: str | None = None) -> InputError:
    return located(part.file, f"session {part.session[0]!s} {text}", row=int(part.rows[row]), column=column)


def _refuse_duplicates(parts: list[Sweeps]) -> None:
    for part in parts:
        # Counted fringes repeat, labels of one moment do not.
        seen: dict[tuple[object, ...], int] = {}
        for i in np.flatnonzero(part.label != ""):
            key = (part.time_h[i], str(part.label[i]), *part.q_start[i], *part.q_end[i], part.dl[i], str(part.group[i]))
            if key in seen:
                raise _refusal(part, i, f"holds the row of line {part.rows[seen[key]]} twice")
            seen[key] = int(i)
    repeated, end = repeated_rows(join(parts)), 0
    for number, after in enumerate(parts):
        begin, end = end, end + len(after)
        # What was sent again under another name or time is no new measurement.
        for before in parts[:number] if 2 * repeated[begin:end].sum() > len(after) else ():
            again = repeated_rows(join([before, after]))[len(before) :]
            if 2 * again.sum() > len(after):
                text = f"repeats session {before.session[0]!s} to the last digit, expected each session once"
                raise _refusal(after, np.argmax(again), text, "session")


def _refuse_future(parts: list[Sweeps], now_h: float | None) -> None:
    for part in parts:
        if now_h is not None:
            if float(part.time_h.max()) > now_h:
                text = f"lies in the future: {part.time_h.max():g} h, now is {now_h:g} h"
                raise _refusal(part, np.argmax(part.time_h), text, "time_h")
            continue
        for i in np.flatnonzero(part.utc != ""):
            if (clock(str(part.utc[i])) - datetime.now(UTC)).total_seconds() / 3600.0 > _CLOCK_SLACK_H:
                text = "lies in the future by this machine's clock (give --now to say when it is)"
                raise _refusal(part, i, text, "utc")


def _check_clocks(parts: list[Sweeps]) -> None:
    """Clock times and hours of all sessions must differ by one constant."""
    seen: list[tuple[float, float, Sweeps]] = []
    for part in parts:
        rows = np.flatnonzero(part.utc != "")
        if not len(rows):
            continue
        hours = np.array([clock(str(part.utc[i])).timestamp() / 3600.0 for i in rows])
        # A session may stand at one time: any of its rows may be the one that time_h means.
        since = hours - part.time_h[rows]
        if len(set(part.time_h[rows].tolist())) > 1 and np.ptp(since) > _CLOCK_STEP_H:
            row = int(part.rows[rows[np.argmax(np.abs(since - np.median(since)))]])
            text = f"utc and time_h of session {part.session[0]!s} part by {np.ptp(since):.4g} h, expected one gap"
            raise located(part.file, text, row=row, column="utc")
        low, high = float(hours.min() - part.time_h[rows].max()), float(hours.max() - part.time_h[rows].min())
        for first, last, other in seen:
            if low > last + _CLOCK_STEP_H or high < first - _CLOCK_STEP_H:
                apart = float(part.time_h[rows[-1]] - other.time_h[0]), hours[-1] - (first + float(other.time_h.max()))
                unit = next((name for name, size in _UNITS.items() if abs(apart[0] / (size * apart[1]) - 1) < 0.05), "")
                hint = f" (time_h looks like {unit})" if unit else " (summer time, a zone, or a clock that was set?)"
                raise located(
                    part.file,
                    f"from session {other.session[0]!s} to {part.session[0]!s} utc counts {apart[1]:.4g} h and time_h "
                    f"{apart[0]:.4g} h, expected the same{hint}",
                    row=int(part.rows[rows[-1]]),
                    column="utc",
                )
        seen.append((low, high, part))
