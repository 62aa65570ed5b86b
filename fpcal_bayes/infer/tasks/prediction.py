"""The distribution of a task's error: bands along the path, peak to peak, probability of exceeding a tolerance.

From an estimate with a Laplace covariance the error is propagated to first order: along gauges that covariance is a
degree wide, and the cavity length is flat only to first order there, so that a nonlinear propagation of Gaussian draws
would count errors that the posterior, which bends with the gauges, does not have. Draws of a posterior are on the bent
surface already and are propagated as they are.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import covariance_root, quantile_band
from fpcal_bayes.core.notebook import Result
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.error import linear_task_sd, peak_to_peak, task_errors, task_jacobian, task_rows
from fpcal_bayes.infer.tasks.pose import PoseErrors, pose_errors, without_common_turn
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics.errors import known_pose_errors, known_task_errors, known_task_sd
from fpcal_bayes.model.trust import Reason, Trust
from fpcal_bayes.motion.tasks import Task, find_task

#: Share of the probability inside a band.
BAND = 0.95
#: No fit leaves a task with less, in um: what it rests on was taken as exact.
_LEAST_SD = 1e-7
OMITTED = Reason("omitted", "the task rests on held values alone, which were taken as exact: its error is not known")
#: Draws of which errors of place and direction are worked out: they are told to two digits.
_POSE_DRAWS = 2000


@dataclass(frozen=True)
class TaskPrediction(Result):
    """What an estimate leaves unknown of a task, as draws."""

    task: Task  # as the controller drives it
    errors: Floats  # task error along the path, shape (n_draws, n_points), in um
    sd: Floats  # root mean square of the error along the path, shape (n_points,), in um
    pose: PoseErrors  # errors of place and direction along the path, of 2,000 of the draws at most
    linear: bool  # whether the errors are propagated to first order from a covariance, or are those of posterior draws
    trust: Trust = field(default_factory=Trust)  # of what the prediction is made from
    # of a machine with error motions: what is the same each time the task is driven, and what return errors add, each
    # (n_draws, n_points) in um; None where the mechanism is taken as perfect
    repeatable: Floats | None = None
    returned: Floats | None = None
    without: float | None = None  # median peak to peak, in um, if the path did not make up for error motions

    def require_usable(self) -> None:
        """Raise `InputError` with the reason if what the prediction is made from is not to be used."""
        if not self.trust.usable:
            raise InputError(f"task {self.task.name}: no band and no probability: {self.trust.against}")

    def __repr__(self) -> str:
        if not self.trust.usable:
            return f"TaskPrediction({self.task.name}, not to be used)"
        low, high = 1e3 * self.peak_to_peak_band()
        return f"TaskPrediction({self.task.name}, {low:.2f} to {high:.2f} nm peak to peak, {len(self.errors)} errors)"

    @property
    def peak_to_peak(self) -> Floats:
        """Peak to peak of each draw along the path, shape (n_draws,), in um."""
        self.require_usable()
        return peak_to_peak(self.errors)

    def band(self) -> Floats:
        """Lower and upper edge of the band that holds `BAND` of the errors at each point, shape (2, n_points), um."""
        self.require_usable()
        return quantile_band(self.errors, BAND, axis=0)

    def peak_to_peak_band(self) -> Floats:
        """Lower and upper edge of the band that holds `BAND` of the peak-to-peak values, shape (2,), in um."""
        self.require_usable()
        return quantile_band(self.peak_to_peak, BAND)

    def exceeds(self, tolerance: float) -> float:
        """Probability that the peak to peak exceeds `tolerance`, in um."""
        self.require_usable()
        return float((self.peak_to_peak > tolerance).mean())


def predict_from_covariance(estimate: Estimate, task: Task, *, draws: int = 10_000, seed: int = 0) -> TaskPrediction:
    """Predict the error of a task from values and covariance, to first order.

    An estimate that knows the cell's error motions predicts them too, with what the joints miss on return.

    Parameters
    ----------
    estimate
        What the controller holds.
    task
        The joint path that was found with it.
    draws, seed
        How many errors to draw, and the seed of numpy's default generator.

    Raises
    ------
    InputError
        If the task belongs to another cell or a point of it is out of reach.
    """
    if estimate.cell.sha256 != task.cell.sha256:
        raise InputError(
            f"the task is of cell {task.cell.name!r}, opd {task.cell.opd!r}, the estimate of {estimate.cell.name!r}, "
            f"opd {estimate.cell.opd!r}: expected the same cell"
        )
    if estimate.mechanics is not None:
        return _on_machine(estimate, task, draws, seed)
    model = CavityModel.of(estimate.cell, estimate.parameters)
    jacobian = task_jacobian(model, estimate.values, task)
    factor = covariance_root(estimate.covariance, estimate.parameters.prior_sd)
    change = np.random.default_rng(seed).standard_normal((draws, len(factor))) @ factor.T
    pose = pose_errors(model, estimate.values + change[:_POSE_DRAWS], estimate.values, task, linear=True)
    sd = linear_task_sd(jacobian, estimate.covariance)
    trust = estimate.trust if sd.max() > _LEAST_SD else estimate.trust.because(OMITTED)
    return TaskPrediction(task, change @ jacobian.T, sd, pose, linear=True, trust=trust)


def covariance_sd(estimate: Estimate, task: Task) -> Floats:
    """Standard deviation of a task's error at each point, shape (n_points,), in um, as `predict_from_covariance`."""
    if estimate.mechanics is not None:
        return known_task_sd(estimate, task.start, task.q, task.added)
    model = CavityModel.of(estimate.cell, estimate.parameters)
    return linear_task_sd(task_jacobian(model, estimate.values, task), estimate.covariance)


def _on_machine(estimate: Estimate, task: Task, draws: int, seed: int) -> TaskPrediction:
    model = CavityModel.of(estimate.cell, estimate.parameters)
    task_rows(model, task)
    made, _, _ = known_task_errors(estimate, task.start, task.q, added=task.added, draws=draws, seed=seed)
    change, added = known_pose_errors(estimate, task.start, task.q, draws=min(draws, _POSE_DRAWS), seed=seed)
    pose = pose_errors(model, estimate.values + change, estimate.values, task, linear=True)
    pose = replace(pose, changes=pose.changes + without_common_turn(model, estimate.values, task, added))
    sd = covariance_sd(estimate, task)
    without = None
    if task.plain is not None:
        plain, _, _ = known_task_errors(estimate, task.start, task.plain, draws=draws, seed=seed)
        without = float(np.median(peak_to_peak(plain.total)))
    return TaskPrediction(task, made.total, sd, pose, True, estimate.trust, made.repeatable, made.returned, without)


def predict_from_draws(
    model: CavityModel, draws: Floats, values: Floats, task: Task, trust: Trust | None = None
) -> TaskPrediction:
    """Predict the error of a task, found with the `values` held (n_free,), from true draws (n_draws, n_free)."""
    errors = task_errors(model, draws, values, task)
    sd = np.sqrt((errors**2).mean(axis=0))
    pose = pose_errors(model, draws[:: -(-len(draws) // _POSE_DRAWS)], values, task)
    return TaskPrediction(task, errors, sd, pose, linear=False, trust=trust or Trust())


def central_draw(model: CavityModel, draws: Floats, task_name: str, *, radius: float | None = None) -> Floats:
    """The draw (n_free,) whose lengths along a task are nearest to the mean: the mean draw is off the surface."""
    task = find_task(model.cell, model.vector(draws[0]), task_name, radius=radius)
    changes = task_errors(model, draws, draws[0], task)
    return np.asarray(draws[int(np.argmin(((changes - changes.mean(axis=0)) ** 2).sum(axis=1)))].copy())
