"""Several solutions of one calibration, told apart by the sessions after it.

Where the posterior after the calibration has more than one minimum (see `all_minima`), the filter starts from the
moments of all of them: right on average, and far from normal. The sessions that follow may show which one it is. So for
some sessions each solution is followed beside them all; where one becomes much likelier than the others and than the
filter that holds them all, it is followed in its place, from the calibration on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.session import SessionOutcome, followed_drift
from fpcal_bayes.tracking.smoother import follow_sessions
from fpcal_bayes.tracking.start import linear_start

#: Sessions after the calibration by which its solutions are compared.
LOOKS = 12
#: A solution is taken when it is this much likelier than anything else (e^7: a thousand times).
_DECISIVE = 7.0
#: Solutions that hold less of the posterior than this are not followed.
_LEAST_SHARE = 0.01
#: With fewer draws for each parameter the covariance of the minimum itself serves.
_DRAWS_PER_PARAMETER = 3


@dataclass(frozen=True)
class CalibrationSolution:
    """One of several solutions of a calibration."""

    estimate: Estimate  # the minimum, with the covariance that a linear filter starts from
    share: float  # of the posterior
    sum_of_squares: float  # at the minimum


def solutions_of(found: Identification, draws: Floats) -> tuple[CalibrationSolution, ...]:
    """The solutions of a calibration, lowest first, none if there is one only; draws count for the nearest."""
    problem, minima = found.problem, (found.solution, *found.other_minima)
    if len(minima) == 1 or not len(draws):
        return ()
    distances = []
    for minimum in minima:
        away = (draws - problem.values(minimum.unknowns)) / found.free.prior_sd
        distances.append(((away @ problem.jacobian(minimum.unknowns)[:, : problem.n_free].T) ** 2).sum(axis=1))
    nearest = np.argmin(distances, axis=0)
    solutions = []
    for number, minimum in enumerate(minima):
        own = draws[nearest == number]
        if len(own) < _LEAST_SHARE * len(draws):
            continue
        estimate = replace(
            found.estimate,
            values=problem.values(minimum.unknowns),
            covariance=problem.covariance(minimum.unknowns)[: problem.n_free, : problem.n_free],
        )
        if len(own) >= _DRAWS_PER_PARAMETER * problem.n_free:
            estimate = linear_start(estimate, own, problem.sweeps)
        solutions.append(CalibrationSolution(estimate, len(own) / len(draws), minimum.sum_of_squares))
    return tuple(solutions) if len(solutions) > 1 else ()


def likeliest(
    drift: DriftModel,
    model: CavityModel,
    limits: Limits,
    together: Sequence[SessionOutcome],
    starts: Sequence[tuple[SessionOutcome, float]],
    parts: Sequence[Sweeps],
) -> list[SessionOutcome]:
    """Outcomes to go on with: from one of `starts` (outcome, share) where the first sessions tell, else `together`."""
    looks = list(parts[: LOOKS + 1])
    courses = [list(together[: LOOKS + 1])]
    for start, _ in starts:
        courses.append(follow_sessions(followed_drift(drift, model, start), model, limits, [start], looks))
    evidence = np.log([1.0, *(share for _, share in starts)])
    counted = [outcomes for outcomes in zip(*(course[1:] for course in courses), strict=True) if _is_evidence(outcomes)]
    for outcomes in counted:
        evidence += [outcome.log_likelihood for outcome in outcomes]
    best = int(np.argmax(evidence))
    lead = evidence[best] - np.delete(evidence, best).max()
    # What fits no solution, such as a slip that nobody noticed, drags the wrong ones along: the right one holds.
    holds = all(outcomes[best].verdict == "as-modelled" for outcomes in counted)
    if best == 0 or lead < _DECISIVE or not holds:
        return list(together)
    chosen = courses[best]
    text = (
        f"of its {len(starts)} solutions the later sessions show which one holds (odds e^{lead:.0f}): all sessions are "
        "followed from this one"
    )
    return [replace(chosen[0], warnings=(*chosen[0].warnings, text)), *chosen[1:]]


def _is_evidence(outcomes: Sequence[SessionOutcome]) -> bool:
    """Whether outcomes of one session may be compared: of the same rows, and expected by some of the courses."""
    same = len({(outcome.n_sweeps, outcome.warnings) for outcome in outcomes}) == 1
    return same and any(outcome.verdict == "as-modelled" for outcome in outcomes)
