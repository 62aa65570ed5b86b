"""The sessions of a campaign in order of time, held to the rules of a history."""

from datetime import UTC, datetime
from itertools import pairwise

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import content_sha256
from fpcal_bayes.core.times import clock, read_time
from fpcal_bayes.measure.sweeps import Sweeps

#: How far a clock may be ahead of this machine's.
_CLOCK_SLACK_H = 0.1


def check_sessions(sweeps: Sweeps, now_h: float | None = None) -> list[Sweeps]:
    """The sweeps of each session, in order of time; `InputError` where they break the rules of a history.

    Sessions may stand in any order in a file: one that arrives late takes its place. They must be measured, not overlap
    or repeat each other, and clock times must run as ``time_h`` does. Sessions after `now_h`, in hours since the
    campaign began, are refused; without it, clock times (``utc``) after this machine's clock are.
    """
    if not sweeps.measured:
        raise InputError(f"{sweeps.file}: expected measured sweeps, with dl_um and sigma_um")
    parts = [sweeps.take(sweeps.session == name) for name in sweeps.sessions]
    for before, after in pairwise(parts):
        end, begin = float(before.time_h.max()), float(after.time_h.min())
        if begin < end:
            raise located(
                sweeps.file,
                f"session {after.session[0]!s} begins at {begin:g} h before session {before.session[0]!s} ends at "
                f"{end:g} h, expected sessions one after the other",
                row=int(after.rows[np.argmin(after.time_h)]),
                column="time_h",
            )
    _refuse_duplicates(parts)
    _refuse_future(parts, now_h)
    _check_clocks(parts)
    return parts


def session_sha256(sweeps: Sweeps) -> str:
    """Hash of everything that a session's rows say."""
    return content_sha256(
        [
            sweeps.time_h.tolist(),
            sweeps.q_start.tolist(),
            sweeps.q_end.tolist(),
            sweeps.dl.tolist(),
            sweeps.sigma.tolist(),
            sweeps.signed.tolist(),
            sweeps.group.tolist(),
            sweeps.kind.tolist(),
            ["" if np.isnan(t) else t for t in sweeps.temperature_c.tolist()],
        ]
    )


def mean_temperature(sweeps: Sweeps) -> float:
    """Mean of the logged temperatures in degrees Celsius, or NaN."""
    logged = sweeps.temperature_c[~np.isnan(sweeps.temperature_c)]
    return float(logged.mean()) if len(logged) else float("nan")


def hours_of(text: str, sweeps: Sweeps) -> float:
    """A time that a user gives, in hours since the campaign began.

    It is hours, or a clock time, which needs a session that carries one; `InputError` otherwise.
    """
    wanted = read_time(text)
    if isinstance(wanted, float):
        return wanted
    row = np.flatnonzero(sweeps.utc != "")
    if not len(row):
        raise InputError(f"{sweeps.file}: no row carries utc: expected the time {text[:40]!r} in hours")
    return float(sweeps.time_h[row[0]]) + (wanted - clock(str(sweeps.utc[row[0]]))).total_seconds() / 3600.0


def hours_now(sweeps: Sweeps, otherwise: float) -> float:
    """The clock of this machine in hours since the campaign began, or `otherwise` if no row carries a clock time."""
    if not (sweeps.utc != "").any():
        return otherwise
    # Within the slack of clocks the last session may seem to lie ahead.
    return max(otherwise, hours_of(datetime.now(UTC).isoformat(), sweeps))


def _refuse_duplicates(parts: list[Sweeps]) -> None:
    for part in parts:
        # Counted fringes repeat, labels of one moment do not.
        seen: dict[tuple[object, ...], int] = {}
        for i in np.flatnonzero(part.label != ""):
            key = (part.time_h[i], str(part.label[i]), *part.q_start[i], *part.q_end[i], part.dl[i], str(part.group[i]))
            if key in seen:
                raise located(
                    part.file,
                    f"session {part.session[0]!s} holds the row of line {part.rows[seen[key]]} twice",
                    row=int(part.rows[i]),
                )
            seen[key] = int(i)
    for before, after in pairwise(parts):
        if session_sha256(before) == session_sha256(after):
            raise located(
                after.file,
                f"session {after.session[0]!s} repeats session {before.session[0]!s}, expected each session once",
                row=int(after.rows[0]),
                column="session",
            )


def _refuse_future(parts: list[Sweeps], now_h: float | None) -> None:
    for part in parts:
        if now_h is not None and float(part.time_h.max()) > now_h:
            raise located(
                part.file,
                f"session {part.session[0]!s} lies in the future: {part.time_h.max():g} h, now is {now_h:g} h",
                row=int(part.rows[np.argmax(part.time_h)]),
                column="time_h",
            )
        if now_h is not None:
            continue
        for i in np.flatnonzero(part.utc != ""):
            ahead = (clock(str(part.utc[i])) - datetime.now(UTC)).total_seconds() / 3600.0
            if ahead > _CLOCK_SLACK_H:
                raise located(
                    part.file,
                    f"session {part.session[0]!s} lies in the future by this machine's clock (give --now to say when "
                    "it is)",
                    row=int(part.rows[i]),
                    column="utc",
                )


def _check_clocks(parts: list[Sweeps]) -> None:
    """Clock times must run the same way as hours."""
    timed = [(part, i) for part in parts for i in np.flatnonzero(part.utc != "")[-1:]]
    for (before, i), (after, j) in pairwise(timed):
        if clock(str(after.utc[j])) < clock(str(before.utc[i])):
            raise located(
                after.file,
                f"sessions {before.session[0]!s} and {after.session[0]!s} stand in another order by utc than by time_h",
                row=int(after.rows[j]),
                column="utc",
            )
