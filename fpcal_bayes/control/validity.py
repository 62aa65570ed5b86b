"""Until when an estimate may be driven with: the horizon that the tracker wrote into it, against the time it is now."""

from datetime import UTC, datetime

import numpy as np

from fpcal_bayes.errors import InputError
from fpcal_bayes.model.estimate import Estimate


class StaleEstimateWarning(UserWarning):
    """An estimate is used after the time until which it holds the tasks."""


def hours_of_estimate(estimate: Estimate, moment: datetime) -> float | None:
    """A moment in hours since the campaign began, or None where the estimate carries no clock time.

    Parameters
    ----------
    estimate
        Its `data` may hold ``utc``, the clock time (ISO 8601) at `time_h`, as the tracker writes it.
    moment
        With its time zone.
    """
    try:
        made = datetime.fromisoformat(str(estimate.data["utc"]))
    except (KeyError, ValueError):
        return None
    made = made if made.tzinfo is not None else made.replace(tzinfo=UTC)
    return estimate.time_h + (moment - made).total_seconds() / 3600.0


def read_now(text: str | None, estimate: Estimate) -> float | None:
    """The time that a user gives, or this machine's clock, in hours since the campaign began; None if not known.

    Parameters
    ----------
    text
        Hours, a clock time as ISO 8601, or None for the clock.

    Raises
    ------
    InputError
        If the text is neither, or is a clock time while the estimate carries none.
    """
    if text is None:
        return hours_of_estimate(estimate, datetime.now(UTC))
    try:
        hours = float(text)
    except ValueError:
        pass
    else:
        if np.isfinite(hours):
            return hours
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(
            f"--now {text[:40]!r}: expected hours since the campaign began, or ISO 8601 as in 2024-05-01T08:30:00Z"
        ) from error
    found = hours_of_estimate(estimate, moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC))
    if found is None:
        raise InputError(f"--now {text[:40]!r}: the estimate carries no clock time, expected hours")
    return found


def stale_text(estimate: Estimate, now_h: float | None) -> str | None:
    """One sentence if an estimate is used after its horizon, else None.

    Parameters
    ----------
    now_h
        In hours since the campaign began, or None where that is not known: then only an estimate that never held its
        tasks is spoken of.
    """
    until = estimate.valid_until_h
    if until is None:
        return None
    if now_h is not None and now_h > until:
        return (
            f"the estimate of {estimate.time_h:.2f} h was valid until {until:.2f} h, {now_h - until:.2f} h ago: "
            "measure, or ask fpcal decide"
        )
    if until <= estimate.time_h:
        return f"the estimate of {estimate.time_h:.2f} h did not hold its tasks when it was made: ask fpcal decide"
    return None
