"""Until when an estimate may be driven with: the horizon that the tracker wrote into it, against the time it is now."""

from dataclasses import replace
from datetime import UTC, datetime

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.times import clock, read_time
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.trust import Reason


class StaleEstimateWarning(UserWarning):
    """An estimate is used after the time until which it holds the tasks."""


def hours_of_estimate(estimate: Estimate, moment: datetime) -> float | None:
    """A moment in hours since the campaign began, or None where the estimate's `data` hold no ``utc`` of `time_h`."""
    try:
        made = clock(str(estimate.data["utc"]))
    except (KeyError, ValueError):
        return None
    return estimate.time_h + (moment - made).total_seconds() / 3600.0


def read_now(text: str | None, estimate: Estimate) -> float | None:
    """The time that a user gives, or this machine's clock, in hours since the campaign began; None if not known."""
    if text is None:
        return hours_of_estimate(estimate, datetime.now(UTC))
    given = read_time(text, "--now")
    if isinstance(given, float):
        return given
    found = hours_of_estimate(estimate, given)
    if found is None:
        raise InputError(f"--now {text[:40]!r}: the estimate carries no clock time, expected hours")
    return found


def judged_at(estimate: Estimate, now_h: float | None) -> Estimate:
    """The estimate with what its age holds against it; `now_h` in hours since the campaign began, None if not known."""
    stale = stale_text(estimate, now_h)
    return estimate if stale is None else replace(estimate, trust=estimate.trust.because(Reason("stale", stale)))


def stale_text(estimate: Estimate, now_h: float | None) -> str | None:
    """A sentence on an estimate used after its horizon, or None; without a time on one that never held its tasks."""
    until = estimate.valid_until_h
    if until is None:
        return None
    if now_h is not None and now_h > until:
        return (
            f"the estimate of {estimate.time_h:.2f} h was valid until {until:.2f} h, which has passed: "
            "measure, or ask fpcal decide"
        )
    if until <= estimate.time_h:
        return f"the estimate of {estimate.time_h:.2f} h did not hold its tasks when it was made: ask fpcal decide"
    return None
