"""The numbers that are shown of a predicted task error and of its uncertainty budget."""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.linalg import quantile_band
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.tasks.budget import Budget
from fpcal_bayes.infer.tasks.error import peak_to_peak
from fpcal_bayes.infer.tasks.pose import FREEDOMS, PoseErrors
from fpcal_bayes.infer.tasks.prediction import BAND, TaskPrediction
from fpcal_bayes.model.cell.tables import OwnTask
from fpcal_bayes.motion.tasks import Task


@dataclass(frozen=True)
class FreedomNumbers:
    """Error of one degree of freedom along a path, in nm or deg; all NaN where it is not to be used."""

    name: str  # ``beam`` (change of cavity length) or one of `FREEDOMS`
    unit: str
    median: float  # peak to peak
    least: float  # lower edge of the band that holds 95 %
    most: float
    low: Floats  # (n_points,)
    high: Floats  # (n_points,)
    sd: Floats  # (n_points,)
    worst: int  # the point where the error is largest, root mean square
    worst_sd: float
    tolerance: float | None
    exceeds: float | None  # probability of a larger peak to peak than the tolerance


@dataclass(frozen=True)
class TaskNumbers(FreedomNumbers):
    """A predicted task error along the beam, angles in deg; NaN, and None, where nothing of it is to be used."""

    task: Task  # as it is driven: points that cannot be reached are left out
    linear: bool  # to first order from a covariance, else from posterior draws
    n_draws: int
    normal: tuple[float, float]  # median and 95 % quantile of the largest angle along the path
    turn: tuple[float, float]
    # peak to peak, median and 97.5 % quantile, of what is the same each time and of what return errors add; None where
    # the mechanism is taken as perfect
    repeatable: tuple[float, float] | None
    returned: tuple[float, float] | None

    @classmethod
    def of(cls, prediction: TaskPrediction, tolerance: float | None = None) -> "TaskNumbers":
        """Numbers of a prediction, with the probability that its peak to peak passes `tolerance` in um."""
        usable, nothing = prediction.trust.usable, np.full((1, len(prediction.sd)), np.nan)
        pose = prediction.pose if usable else PoseErrors(nothing, np.repeat(nothing[..., None], len(FREEDOMS), axis=-1))
        return cls(
            **vars(_freedom(prediction, "beam", tolerance)),
            task=prediction.task,
            linear=prediction.linear,
            n_draws=len(prediction.errors),
            normal=_largest(np.degrees(pose.normal)),
            turn=_largest(np.degrees(pose.turn)),
            repeatable=_ranges(prediction.repeatable) if usable else None,
            returned=_ranges(prediction.returned) if usable else None,
        )


def freedom_numbers(prediction: TaskPrediction, tolerances: dict[str, float]) -> list[FreedomNumbers]:
    """Every degree of freedom of a task; `tolerances` are largest peak to peaks by name, in um and rad."""
    return [_freedom(prediction, name, tolerances.get(name)) for name in ("beam", *FREEDOMS)]


def _freedom(prediction: TaskPrediction, name: str, limit: float | None) -> FreedomNumbers:
    usable = prediction.trust.usable
    errors = prediction.errors if name == "beam" else prediction.pose.of(name)
    errors = errors if usable else np.full((1, errors.shape[-1]), np.nan)
    unit, scale = ("deg", float(np.degrees(1.0))) if name.startswith("r") else ("nm", 1e3)
    stated = None if limit is None else scale * limit
    widths = scale * peak_to_peak(errors)
    sd = scale * (prediction.sd if name == "beam" and usable else np.sqrt((errors**2).mean(axis=0)))
    least, most = quantile_band(widths, BAND).tolist()
    low, high = scale * quantile_band(errors, BAND, axis=0)
    worst, median = int(np.argmax(sd)), float(np.median(widths))
    exceeds = None if stated is None or not usable else float((widths > stated).mean())
    return FreedomNumbers(name, unit, median, least, most, low, high, sd, worst, float(sd[worst]), stated, exceeds)


def judged(prediction: TaskPrediction, task: OwnTask) -> dict[str, float | None]:
    """Probability that each tolerance of a task, by its name, is passed peak to peak; None where nothing is known."""
    found = {numbers.name: numbers.exceeds for numbers in freedom_numbers(prediction, task.tolerances)}
    return {name: found[name] for name in task.tolerances}


def _ranges(errors: Floats | None) -> tuple[float, float] | None:
    """Median and upper edge of the peak to peak in nm."""
    if errors is None:
        return None
    middle, most = np.quantile(np.ptp(errors, axis=1), [0.5, 0.975])
    return 1e3 * float(middle), 1e3 * float(most)


def _largest(angles: Floats) -> tuple[float, float]:
    median, high = np.quantile(angles.max(axis=1), [0.5, 0.95])
    return float(median), float(high)


def variance_shares(budget: Budget) -> list[float] | None:
    """Share of each input in the variance of a budget, or None where the inputs are not independent."""
    total = budget.combined**2
    if not (total > 0 and np.allclose(budget.correlation, np.eye(len(budget.lines)), atol=1e-6)):
        return None
    return [line.contribution**2 / total for line in budget.lines]


def correlated_inputs(budget: Budget) -> list[tuple[str, str, float]]:
    """Pairs of inputs whose contributions are correlated by half a per cent or more, with the correlation."""
    names = [line.name for line in budget.lines]
    return [
        (names[j], names[i], float(budget.correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(budget.correlation[i, j]) >= 0.005
    ]
