"""Does a plan keep its promise? Each truth is calibrated twice: with the plan, and with the paper's sweeps.

Compared is the largest error along each task that the controller makes with either calibration.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.tasks.error import task_errors
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.study.base import Results, Study, Summary, drawn_truth, sweeps_sha256

#: Points of each path.
_POINTS = 31
#: Sets of truths drawn from those simulated, to tell how far chance alone moves a ratio.
_SETS = 1000


def largest_errors(cell: Cell, values: Floats, plan: Sweeps, *, sigma: float, seed: int) -> dict[str, float]:
    """Largest error along each task, in um, after identifying a simulated cell from simulated measurements.

    `values` (n_free,) are the truth's free parameters in um and rad; `sigma` is the standard deviation of each change
    of cavity length in um. NaN where the estimate leaves no point to drive to.
    """
    model = CavityModel.of(cell)
    truth = Truth(cell.free, np.zeros(1), values[None])
    found = identify(cell, simulate_um(cell, truth, plan, sigma=sigma, seed=seed)).estimate
    result = dict.fromkeys(DEFAULT_TASKS, np.nan)
    for name in DEFAULT_TASKS:
        try:
            task = find_task(cell, found.vector(), name, n_points=_POINTS)
        except InputError:
            # By its estimate, this robot's joint limits do not let it take the aligned pose.
            continue
        if task.ok.any():
            result[name] = float(np.abs(task_errors(model, values, found.values, task.take(task.ok))).max())
    return result


def compare(ours: Floats, theirs: Floats) -> dict[str, float]:
    """One kind of error or standard deviation, above zero, over another at the same truths, shape (n_truths,) each.

    The ratio of the root mean squares and of the medians, and the mean over truths of the ratio, each with its standard
    error (``.._se``) by drawing the truths anew (bootstrap, Efron 1979). The mean ratio of simulated errors leans
    upwards: some truth's error is small by luck.
    """
    picked = np.random.default_rng(0).integers(len(ours), size=(_SETS, len(ours)))

    def ratios(a: Floats, b: Floats) -> dict[str, Floats]:
        return {
            "ratio_of_rms": np.sqrt((a**2).mean(axis=-1) / (b**2).mean(axis=-1)),
            "mean_ratio": (a / b).mean(axis=-1),
            "ratio_of_medians": np.median(a, axis=-1) / np.median(b, axis=-1),
        }

    spread = {name: float(values.std()) for name, values in ratios(ours[picked], theirs[picked]).items()}
    found: dict[str, float] = {}
    for name, value in ratios(ours, theirs).items():
        found |= {name: float(value), f"{name}_se": spread[name]}
    return found


@dataclass(frozen=True, kw_only=True)
class Planning(Study):
    """The study of a plan."""

    name: ClassVar[str] = "plan"

    plan: Sweeps  # rows of the plan, as they are read
    sigma: float = 0.005  # standard deviation of each change of cavity length, in um
    paper: Sweeps = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "paper", paper_protocol(self.cell))

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the numbers that one replicate gives; lengths in um."""
        return dict.fromkeys(("plan", "paper"), (len(DEFAULT_TASKS),))

    def settings(self) -> dict[str, Any]:
        """The plan and the noise."""
        return {"sweeps_sha256": sweeps_sha256(self.plan), "sigma_um": self.sigma}

    def replicate(self, number: int) -> dict[str, Floats]:
        """Largest error along each task with the plan and with the paper's sweeps."""
        random = self.random(number)
        values, seed = drawn_truth(self.cell, random).values[0], int(random.integers(2**31))
        plans = {"plan": self.plan, "paper": self.paper}
        errors = {
            name: largest_errors(self.cell, values, plan, sigma=self.sigma, seed=seed) for name, plan in plans.items()
        }
        return {name: np.array([found[task] for task in DEFAULT_TASKS]) for name, found in errors.items()}

    def summary(self, results: Results) -> Summary:
        """Errors with the plan over those with the paper's sweeps."""
        rows: list[dict[str, str | int | float]] = []
        for i, task in enumerate(DEFAULT_TASKS):
            ours, theirs = results["plan"][:, i], results["paper"][:, i]
            both = np.isfinite(ours + theirs)
            ours, theirs = ours[both], theirs[both]
            row: dict[str, str | int | float] = {"task": task, "n": int(both.sum())}
            if both.any():
                row |= {
                    "plan_median_nm": 1e3 * float(np.median(ours)),
                    "paper_median_nm": 1e3 * float(np.median(theirs)),
                    **compare(ours, theirs),
                    "better_percent": 100.0 * float((ours < theirs).mean()),
                }
            rows.append(row)
        title = f"largest error along each task, {len(self.plan)} rows of the plan, {len(self.paper)} of the paper"
        return Summary(title, [row for row in rows if row["n"]], [f"{len(results['plan'])} truths calibrated twice"])
