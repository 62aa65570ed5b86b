"""Session after session: each is taken in, and now and then all are looked at again from where they lead.

An update leaves the rows of its session linearised where the state was then. While the first sessions still move the
state through a bend of the model, what that linearisation says of the place where the state ends is off, and the filter
claims more than it knows. So after the second session, the fourth, the eighth, and so on, the state becomes the last
one of the iterated smoother: all sessions linearised again where they lead together. As the intervals double, that
costs a few smoothings' worth in all.
"""

from collections.abc import Sequence
from dataclasses import replace

from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.track.consistency import Limits
from fpcal_bayes.track.drift import DriftModel
from fpcal_bayes.track.smoother import smooth, with_measurements
from fpcal_bayes.track.step import SessionOutcome, take_in

#: After this many sessions the state no longer moves far, and looking at all again would take long.
_LAST_LOOK = 64


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
        sessions = len(outcomes) - 1
        if 1 < sessions <= _LAST_LOOK and sessions.bit_count() == 1:
            outcomes = with_measurements(drift, model, limits, outcomes, parts)
            outcomes[-1] = replace(outcomes[-1], state=smooth(drift, outcomes).states[-1])
    return outcomes
