"""How far a state can be trusted: the error of tasks as time passes, and when it is likely to leave its tolerance.

The controller drives with the estimate of the last session. What it then does not know of a task is, to first order,

    e = J (x(t) - x_estimate),    x(t) ~ N(m(t), P(t)),

with m(t) and P(t) carried forward by the drift model. The probability that the peak to peak of e passes the tolerance
is counted over draws; the same draws serve every time and every covariance, so that the probability is smooth in time.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import quantile_band, symmetric_root
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.error import peak_to_peak, task_jacobian
from fpcal_bayes.infer.tasks.pose import FREEDOMS, pose_jacobian
from fpcal_bayes.infer.tasks.source import PATH_POINTS
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.motion.tasks import Task, find_task
from fpcal_bayes.tracking.drift import DriftModel, State

#: Points of a circle, whose peak to peak they meet within 0.4 %, and of the other tasks, which are smoother.
_CIRCLE_POINTS, _POINTS = 37, 9
#: Draws by which probabilities are counted: 0.10 is told within 0.007.
_DRAWS = 2048
#: Combinations of the parameters whose prior moves a path by less than this share of the tolerance are left out.
_NEGLIGIBLE = 1e-3
#: The horizon is searched at this many times, then halved until the time is known within a minute.
_STEPS = 12
_MINUTE_H = 1.0 / 60.0


@dataclass(frozen=True)
class Goal:
    """What the cell must hold; `InputError` if a number is out of its range or no task is named."""

    tolerance_nm: float  # largest peak to peak of the error of any of the tasks
    # Names as in `TASKS`, of the cell's own, or path files. Tolerances that a task of the cell's own states for other
    # degrees of freedom hold too: their errors count as the same share of this tolerance.
    tasks: tuple[str, ...] = ("circle",)
    # Probability of passing the tolerance that is accepted before the next measurement. In weeks that drift as modelled
    # the time spent outside is about a third of it, as the probability grows from zero after each session.
    level: float = 0.1
    radius_um: float | None = None  # of the circle; by default as far as the cell's limits let it be
    compensate: bool = True  # whether the controller makes up for the error motions that it knows of, where that gains

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance_nm) and self.tolerance_nm > 0):
            raise InputError(f"tolerance {self.tolerance_nm:g} nm: expected a number above zero")
        if not 0 < self.level < 1:
            raise InputError(f"level {self.level:g}: expected a probability between 0 and 1")
        if not self.tasks:
            raise InputError("no task: expected at least one that the cell must hold")

    @property
    def tolerance_um(self) -> float:
        """The tolerance in um."""
        return 1e-3 * self.tolerance_nm


@dataclass(frozen=True)
class TaskForecast:
    """Error of the tasks at one time."""

    time_h: float  # hours since the campaign began
    peaks: Floats  # peak to peak of each task in each draw, shape (n_tasks, n_draws), in um

    @property
    def worst(self) -> Floats:
        """Peak to peak of the worst task in each draw, shape (n_draws,), in um."""
        return self.peaks.max(axis=0)

    @property
    def median(self) -> float:
        """Median over the draws of the worst task, in um."""
        return float(np.median(self.worst))

    def band(self) -> tuple[float, float]:
        """Lower and upper edge of the band that holds 95 % of the worst task's peak to peak, in um."""
        low, high = quantile_band(self.worst, 0.95).tolist()
        return low, high

    def exceeds(self, tolerance: float) -> float:
        """Probability that any task passes `tolerance`, in um."""
        return float((self.worst > tolerance).mean())

    def attainable(self, level: float) -> float:
        """The tolerance that is passed with probability `level`, in um."""
        return float(np.quantile(self.worst, 1.0 - level, method="higher"))


@dataclass(frozen=True)
class Forecaster:
    """Errors of tasks under one estimate, at any later time and after any further measurement."""

    drift: DriftModel  # what the states mean and how they move
    goal: Goal  # what is to be held
    estimate: Floats  # mean of the state that the controller holds, shape (n_states,)
    jacobian: Floats  # of all points of all tasks by the states of cavity lengths, shape (n_points, n_lengths), in um
    tasks: tuple[slice, ...]  # the points of each task, one degree of freedom after the other
    counts: tuple[int, ...]  # how many degrees of freedom each task is held to
    # joint vectors of the aligned pose and of the ends and middle of each task, shape (n_poses, n_joints)
    poses: Floats
    basis: Floats  # of `jacobian`, cut to what matters, shape (n_points, rank)
    factor: Floats  # likewise, shape (rank, n_lengths)
    draws: Floats  # standard normal, shape (rank, n_draws)
    # of a machine: what is new each time, such as return errors, and what stays of the known motions, in um, shape
    # (n_points, n_draws)
    new: Floats | None = None

    @classmethod
    def of(cls, drift: DriftModel, model: CavityModel, goal: Goal, mean: Floats) -> "Forecaster":
        """The forecast for the estimate that the controller holds, the mean of a state (n_states,)."""
        vector = model.vector(drift.values(mean))
        machine = drift.motions is not None
        counts = [PATH_POINTS if machine else _CIRCLE_POINTS if name == "circle" else _POINTS for name in goal.tasks]
        tasks = [
            find_task(model.cell, vector, name, radius=goal.radius_um, n_points=count).within_turns()
            for name, count in zip(goal.tasks, counts, strict=True)
        ]
        poses = np.vstack([tasks[0].start, *(t.q[[0, len(t) // 2, -1]] for t in tasks if t.name != "circle")])
        found = [_held(drift, model, goal, name, task, mean) for name, task in zip(goal.tasks, tasks, strict=True)]
        jacobian = np.vstack([rows for rows, _ in found])
        new = np.vstack([each for _, each in found if each is not None]) if machine else None
        ends = np.cumsum([0, *(len(rows) for rows, _ in found)]).tolist()
        held = tuple(len(rows) // len(task) for (rows, _), task in zip(found, tasks, strict=True))
        left, singular, right = np.linalg.svd(jacobian, full_matrices=False)
        kept = singular > _NEGLIGIBLE * goal.tolerance_um
        factor = singular[kept, None] * right[kept]
        draws = np.random.default_rng(0).standard_normal((len(factor), _DRAWS))
        slices = tuple(slice(a, b) for a, b in pairwise(ends))
        return cls(drift, goal, np.array(mean), jacobian, slices, held, poses, left[:, kept], factor, draws, new)

    def following(self, mean: Floats) -> "Forecaster":
        """The same for a controller that takes over another estimate; its tasks move by too little to matter."""
        return replace(self, estimate=np.array(mean))

    def outlook(self, state: State) -> TaskForecast:
        """Error of the tasks if the truth is drawn from `state`."""
        n = self.drift.n_lengths
        offset = self.factor @ (state.mean[:n] - self.estimate[:n])
        change = offset[:, None] + symmetric_root(self.factor @ state.covariance[:n, :n] @ self.factor.T) @ self.draws
        # Points in rows: the peak to peak over them then runs over the draws side by side.
        errors = self.basis @ change if self.new is None else self.basis @ change + self.new
        peaks = [
            np.max([peak_to_peak(part.T) for part in np.split(errors[points], count)], axis=0)
            for points, count in zip(self.tasks, self.counts, strict=True)
        ]
        return TaskForecast(state.time_h, np.array(peaks))

    def ahead(self, state: State, hours: float) -> State:
        """The state after some hours in which nothing is measured and the temperature stays."""
        mean, covariance = self.drift.propagate(state.mean, state.covariance, hours)
        return replace(state, time_h=state.time_h + hours, mean=mean, covariance=covariance)

    def exceeds(self, state: State, hours: float = 0.0) -> float:
        """Probability that a task is out of tolerance some hours after `state`."""
        return self.outlook(self.ahead(state, hours)).exceeds(self.goal.tolerance_um)

    def hold_hours(self, state: State, horizon_h: float) -> float:
        """Hours after `state` until the level is passed, to the minute below; zero if it is, at most `horizon_h`."""
        inside = 0.0
        for outside in (0.0, *np.geomspace(min(0.25, horizon_h / 2.0), horizon_h, _STEPS).tolist()):
            if self.exceeds(state, outside) > self.goal.level:
                break
            inside = outside
        else:
            return horizon_h
        while outside - inside > _MINUTE_H:
            middle = (inside + outside) / 2.0
            if self.exceeds(state, middle) > self.goal.level:
                outside = middle
            else:
                inside = middle
        return inside


def _held(
    drift: DriftModel, model: CavityModel, goal: Goal, name: str, task: Task, mean: Floats
) -> tuple[Floats, Floats | None]:
    """Errors in um of the tolerance by the states (n_rows, n_lengths); on a machine what is new (n_rows, n_draws)."""
    # Rows are the points along the beam, then those of each freedom with a tolerance.
    own = {each.name: each.tolerances for each in model.cell.tasks}.get(name, {})
    shares = {freedom: goal.tolerance_um / limit for freedom, limit in own.items() if freedom != "beam"}
    values, motions = drift.values(mean), drift.motions
    states, new = np.zeros((len(task), 0)), None
    if motions is not None:
        moving = mean[drift.n_parameters : drift.n_lengths]
        task, states, new = motions.path(model.vector(values), moving, task, _DRAWS, goal.compensate)
    rows = [np.hstack([task_jacobian(model, values, task) * drift.scale, states])]
    news = [new]
    if shares:
        slopes = pose_jacobian(model, values, task)[1] * drift.scale[:, None, None]
        if motions is not None:
            felt, fresh = motions.pose_path(model, values, moving, task, _DRAWS)
            slopes = np.concatenate([slopes, felt])
        for freedom, share in shares.items():
            at = FREEDOMS.index(freedom)
            rows.append(share * slopes[..., at].T)
            news.append(None if motions is None else share * fresh[..., at].T)
    return np.vstack(rows), None if motions is None else np.vstack([each for each in news if each is not None])
