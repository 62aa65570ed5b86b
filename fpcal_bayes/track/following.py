"""Session after session: each is taken in, and now and then all are looked at again from where they lead.

An update leaves the rows of its session linearised where the state was then. While the first sessions still move the
state through a bend of the model, what that linearisation says of the place where the state ends is off, and the filter
claims more than it knows. So after the second session, the fourth, the eighth, and so on, the state becomes the last
one of the iterated smoother: all sessions linearised again where they lead together. As the intervals double, that
costs a few smoothings' worth in all. After a jump was allowed for the state is wide again: then each of the next
sessions is followed by a look, and a second count begins.
"""

from collections.abc import Sequence
from dataclasses import replace

from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.track.consistency import Limits
from fpcal_bayes.track.drift import DriftModel
from fpcal_bayes.track.smoother import smooth, with_measurements
from fpcal_bayes.track.step import SessionOutcome, take_in

#: So many sessions are looked at again, at most: what was before hardly moves the state any more.
_MOST_SESSIONS = 64
#: So many sessions after a jump each is followed by such a look.
_AFTER_JUMP = 8


def follow_sessions(
    drift: DriftModel, model: CavityModel, limits: Limits, known: Sequence[SessionOutcome], parts: Sequence[Sweeps]
) -> list[SessionOutcome]:
    """Take in the sessions after those that are known.

    Parameters
    ----------
    drift, model
        Of the same parameters; the drift with its `hidden` noise.
    limits
        Of the tests.
    known
        Outcomes of the first sessions, at least of the calibration.
    parts
        Sweeps of all sessions, in order of time.
    """
    outcomes = list(known)
    for part in parts[len(outcomes) :]:
        before = outcomes[-1]
        outcomes.append(take_in(drift, model, limits, before.state, before.monitor, part))
        if _is_due(outcomes):
            first = max(0, len(outcomes) - _MOST_SESSIONS)
            outcomes[first:] = with_measurements(drift, model, limits, outcomes[first:], parts[first:])
            outcomes[-1] = looked_at_again(drift, outcomes)
    return outcomes


def looked_at_again(drift: DriftModel, outcomes: Sequence[SessionOutcome]) -> SessionOutcome:
    """The last outcome; where a look is due, with the state to which the sessions lead together.

    Parameters
    ----------
    drift
        With its `hidden` noise.
    outcomes
        From the calibration on, with the measurements of the last sessions.
    """
    last = outcomes[-1]
    if not _is_due(outcomes):
        return last
    recent = list(outcomes[-_MOST_SESSIONS:])
    if len(recent) < len(outcomes):
        recent[0] = replace(recent[0], measurement=None)
    smoothed = smooth(drift, recent)
    return replace(last, state=smoothed.states[-1]) if smoothed.converged else last


def _is_due(outcomes: Sequence[SessionOutcome]) -> bool:
    """Whether the sessions are to be looked at again."""
    count = len(outcomes) - 1
    alarms = [number for number, outcome in enumerate(outcomes) if outcome.jump.any()]
    since = count - alarms[-1] if alarms else 0
    return count > 1 and (count.bit_count() == 1 or 0 < since <= _AFTER_JUMP or since.bit_count() == 1)
