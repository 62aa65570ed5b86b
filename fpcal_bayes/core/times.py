"""Times as a user gives them: hours since the campaign began, or clock times."""

from datetime import UTC, datetime

from fpcal_bayes.core.errors import InputError, largest


def clock(text: str) -> datetime:
    """A clock time as ISO 8601 says it; without a zone it is UTC."""
    time = datetime.fromisoformat(text)
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)


def iso(moment: float) -> str:
    """A Unix time as files hold it: ISO 8601 to the millisecond."""
    return datetime.fromtimestamp(moment, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def read_time(text: str, name: str = "time") -> float | datetime:
    """Hours since the campaign began, or a clock time; `name` is what errors call it."""
    try:
        hours = float(text)
    except ValueError:
        pass
    else:
        if abs(hours) <= largest("h"):
            return hours
    try:
        return clock(text)
    except ValueError as error:
        raise InputError(
            f"{name} {text[:40]!r}: expected hours since the campaign began, or ISO 8601 as in 2024-05-01T08:30:00Z"
        ) from error
