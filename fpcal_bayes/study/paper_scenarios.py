"""Three ways through the same simulated week: the paper's protocol, a filter on the same sweeps, and our policy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.decision.closed_loop import run_policy, task_peaks
from fpcal_bayes.decision.decision import Costs
from fpcal_bayes.decision.forecast import Forecaster, Goal
from fpcal_bayes.decision.policy import Policy
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.tasks.source import PATH_POINTS
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.motion.compensation import compensated
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.study.paper_week import driven_error
from fpcal_bayes.tracking.drift import DriftModel
from fpcal_bayes.tracking.session import SessionOutcome
from fpcal_bayes.tracking.tracker import Track, estimate_of, track

#: The task error is looked at so often.
LOOK_H = 0.1
_MACHINE_LOOK_H = 0.5
_GOAL = Goal(50.0)
#: On a machine that cannot meet it, this many times the least that can be met stands in its place, in tens of nm.
_ROOM = 1.5


@dataclass(frozen=True)
class Scenario:
    """One way through the week."""

    name: str
    # session_h, session_sweeps: when something was measured, and how many sweeps, shape (n_sessions,); the first is day
    # 0's calibration
    session_h: Floats
    session_sweeps: NDArray[np.int64]
    minutes: float  # spent on measuring after day 0
    # times_h, peaks: peak to peak of the circle's error with the estimate held at each time, shapes (t,), in um
    times_h: Floats
    peaks: Floats
    tolerance: float  # in um

    @property
    def share(self) -> float:
        """Share of the time in tolerance."""
        return float((self.peaks <= self.tolerance).mean())

    @property
    def spent(self) -> int:
        """Sweeps after day 0."""
        return int(self.session_sweeps[1:].sum())


@dataclass(frozen=True)
class Followed:
    """What following the week gave."""

    track: Track  # the filter on the sweeps of the paper's protocol
    policy_track: Track  # the policy's sessions
    policy_sweeps: Sweeps  # all its sweeps, those of day 0 included
    goal: Goal  # of the policy
    courses: tuple[Scenario, ...]  # the paper's, the filter's, the policy's


def follow_week(
    cell: Cell,
    truth: Truth,
    sweeps: Sweeps,
    identifications: dict[str, Identification],
    *,
    sigma: float,
    seed: int,
    progress: Callable[[str], None] = lambda text: None,
) -> Followed:
    """Follow the week with the filter, live it again under the policy, and judge both beside the paper's protocol.

    `sweeps` and `identifications` are of the paper's sessions, in order of time; `sigma` in um and `seed` are of the
    policy's sweeps. `InputError` if the cell states no drift, or the tolerance cannot be met.
    """
    drift = DriftModel.of(cell)
    model = CavityModel.of(cell, drift.parameters)
    progress("following the sessions with the filter")
    followed = track(cell, sweeps, drift=drift)
    progress("living the week again under the policy")
    first = sweeps.of_session(followed.outcomes[0].session)
    costs = Costs(most_sweeps=2, sigma_nm=1e3 * sigma, diagnosis_h=24.0)
    policy = _within_reach(Policy.of(drift, model, _GOAL, costs, paper_protocol(cell)), followed)
    goal = policy.goal
    end_h = float(truth.times_h[-1])
    noises = np.random.SeedSequence([seed, 1])

    def measure(plan: Sweeps, time_h: float) -> Sweeps:
        """What a plan gives on the simulated cell, each with noise of its own."""
        n, noise = len(plan), int(noises.spawn(1)[0].generate_state(1)[0])
        timed = replace(plan, session=np.full(n, f"h{time_h:06.2f}"), time_h=np.full(n, time_h))
        return simulate_um(cell, truth, timed, sigma=sigma, seed=noise, machine_seed=seed)

    loop = run_policy(policy, followed.outcomes[0], measure, end_h)
    progress("judging the week")
    look_h = LOOK_H if cell.mechanics is None else _MACHINE_LOOK_H
    times = np.arange(0.0, end_h + look_h / 2.0, look_h)
    paper = [(found.estimate.time_h, found.estimate) for found in identifications.values()]
    paper_sweeps = np.array([len(found.problem.sweeps) for found in identifications.values()])
    held = {
        "the paper's protocol": (paper, paper_sweeps),
        "filter, the same sweeps": (_held(followed, followed.outcomes), paper_sweeps),
        "policy": (_held(followed, loop.outcomes), np.array([len(first), *(len(part) for part in loop.sweeps)])),
    }

    def peaks(estimates: list[tuple[float, Estimate]]) -> Floats:
        if cell.mechanics is not None:
            return _machine_peaks(cell, truth, estimates, goal, times, seed)
        values = [(time_h, found.vector()[drift.parameters.slots]) for time_h, found in estimates]
        return np.asarray(task_peaks(model, truth, values, goal.tasks, times, radius=goal.radius_um)[0])

    courses = []
    for name, (estimates, counts) in held.items():
        when, spent = np.array([time for time, _ in estimates]), sum(costs.minutes(int(n)) for n in counts[1:])
        courses.append(Scenario(name, when, counts, spent, times, peaks(estimates), goal.tolerance_um))
    everything = join([first, *loop.sweeps], file="policy.h5")
    return Followed(followed, replace(followed, outcomes=loop.outcomes), everything, goal, tuple(courses))


def _within_reach(policy: Policy, followed: Track) -> Policy:
    """The policy, with a tolerance that the machine can meet."""
    start = followed.outcomes[0].state
    policy = replace(policy, drift=followed.drift)
    forecast = Forecaster.of(policy.drift, policy.model, policy.goal, start.mean)
    least_nm = policy.decide(forecast, forecast.ahead(start, policy.costs.horizon_h)).attainable_nm
    if least_nm is None:
        return policy
    return replace(policy, goal=replace(policy.goal, tolerance_nm=10.0 * float(np.ceil(_ROOM * least_nm / 10.0))))


def _held(followed: Track, outcomes: Sequence[SessionOutcome]) -> list[tuple[float, Estimate]]:
    """The estimates that a controller holds, and from when on."""
    return [(o.time_h, estimate_of(followed.cell, followed.drift, o.state, followed.status)) for o in outcomes]


def _machine_peaks(
    cell: Cell, truth: Truth, held: Sequence[tuple[float, Estimate]], goal: Goal, times: Floats, seed: int
) -> Floats:
    """As `task_peaks` of the goal's first task, driven on the machine with compensation, shape (t,)."""
    paths = [find_task(cell, e.vector(), goal.tasks[0], radius=goal.radius_um, n_points=PATH_POINTS) for _, e in held]
    tasks = [compensated(estimate, path.driven()) for (_, estimate), path in zip(held, paths, strict=True)]
    number = np.searchsorted([begin for begin, _ in held], times + 1e-9) - 1
    driven = zip(number, times.tolist(), strict=True)
    return np.array([np.ptp(driven_error(cell, truth, tasks[i], held[i][1], t, seed)) for i, t in driven])
