"""The uncertainty budget of a task in the form of the GUM (JCGM 100:2008, 101:2008).

The measurand is the change of cavity length, from the aligned pose to the worst point of a task, that the controller
does not know of. Its inputs are

- the parameters by block as the estimate's covariance has them: blocks are correlated;
- laser wavelength and air index: a scale of every cavity length that is read, and so of the change that the estimate
  expects along the task, which the controller keeps constant on the axis path: hardly an error there;
- repeatability and resolution of the joints while the task is driven; of a machine with error motions their terms.
"""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.linalg import covariance_root, quantile_band
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.prior_sizes import kinds
from fpcal_bayes.infer.tasks.error import linear_task_sd, task_jacobian, task_rows
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics.errors import known_task_errors
from fpcal_bayes.motion.tasks import Task

#: Share of the probability inside the coverage interval, and draws of its Monte Carlo evaluation (JCGM 101).
COVERAGE = 0.95
_DRAWS = 200_000
#: Of a machine: causes below this share of the whole stand together.
_LEAST_SHARE = 0.02


@dataclass(frozen=True)
class Conditions:
    """What is known of the laser and the air beside the estimate; type B."""

    wavelength_ppm: float = 1.0  # half width of the rectangular distribution of the laser's vacuum wavelength
    # temperature_k, pressure_hpa: half widths of the air's temperature and pressure around those that the wavelength in
    # air was worked out for
    temperature_k: float = 1.0
    pressure_hpa: float = 10.0

    @property
    def index_ppm(self) -> float:
        """Half width of the air index that temperature and pressure make, in ppm; Edlen's formula near 20 deg C."""
        return float(np.hypot(0.93 * self.temperature_k, 0.27 * self.pressure_hpa))


@dataclass(frozen=True)
class Line:
    """One input of a budget."""

    name: str
    evaluation: str  # ``A`` (from repeated observations), ``B`` (otherwise), or ``A, B`` where both are combined
    distribution: str  # ``normal`` or ``rectangular``
    unit: str  # of estimate and standard uncertainty: ``um``, ``rad`` or ``ppm``
    estimate: float  # best estimate of the input; its deviation from what is used, zero here
    standard_uncertainty: float  # in `unit`
    # um of the measurand per `unit`; root of the sum of squares where an input acts more than once. Inputs that stand
    # for many parameters are given as their joint contribution, with sensitivity 1.
    sensitivity: float

    @property
    def contribution(self) -> float:
        """Standard uncertainty of the measurand from this input, in um."""
        return abs(self.sensitivity) * self.standard_uncertainty


@dataclass(frozen=True)
class Budget:
    """An uncertainty budget."""

    task: str
    along: float  # where on it the worst point stands, in `unit`
    unit: str
    lines: tuple[Line, ...]
    correlation: Floats  # of the inputs' contributions, signs of the sensitivities included, shape (n, n)
    interval: tuple[float, float]  # probabilistically symmetric, by Monte Carlo, in um

    @property
    def combined(self) -> float:
        """Combined standard uncertainty in um, JCGM 100 equation (16)."""
        contributions = np.array([line.contribution for line in self.lines])
        return float(np.sqrt(max(float(contributions @ self.correlation @ contributions), 0.0)))


#: Of an ordinary laboratory.
_USUAL = Conditions()


def budget_of(estimate: Estimate, task: Task, *, conditions: Conditions = _USUAL) -> Budget:
    """The uncertainty budget, at its worst point, of a task whose joint path was found with `estimate`."""
    if estimate.mechanics is not None:
        return _machine_budget(estimate, task, conditions)
    model = CavityModel.of(estimate.cell, estimate.parameters)
    jacobian = task_jacobian(model, estimate.values, task)
    worst = int(np.argmax(linear_task_sd(jacobian, estimate.covariance)))
    row = jacobian[worst]
    change = float(model.predict(estimate.values, task_rows(model, task))[worst])
    lines, correlation = _posterior_lines(estimate, row)
    lines += _scale_lines(conditions, change)
    lines += _joint_lines(estimate, model, task, worst)
    return _budget(task, worst, lines, correlation)


def _machine_budget(estimate: Estimate, task: Task, conditions: Conditions) -> Budget:
    """Of a machine: geometry by block, error motions, reversal, drift and return by term, as its draws have them."""
    made, change, parts = known_task_errors(estimate, task.start, task.q)
    worst = int(np.argmax(made.total.std(axis=0)))
    model = CavityModel.of(estimate.cell, estimate.parameters)
    row = task_jacobian(model, estimate.values, task)[worst]
    effects = {name: change[:, members] @ row[members] for name, members in kinds(estimate.parameters)}
    effects |= {name: errors[:, worst] for name, errors in parts.items() if name != "geometry"}
    least = _LEAST_SHARE * float(made.total[:, worst].std())
    small = [name for name, errors in effects.items() if errors.std() < least]
    if small:
        effects["all others"] = np.sum([effects.pop(name) for name in small], axis=0)
    values = np.array(list(effects.values()))
    sd = values.std(axis=1)
    correlation = np.atleast_2d(np.corrcoef(values[sd > 0]))
    shown = [(name, float(size)) for name, size in zip(effects, sd, strict=True) if size > 0]
    lines = [Line(name, "A, B", "normal", "um", 0.0, size, 1.0) for name, size in shown]
    lines += _scale_lines(conditions, float(model.predict(estimate.values, task_rows(model, task))[worst]))
    lines += [line for line in _joint_lines(estimate, model, task, worst) if line.name.startswith("resolution")]
    return _budget(task, worst, lines, correlation)


def _scale_lines(conditions: Conditions, scale: float) -> list[Line]:
    """Laser and air, which scale every length."""
    widths = {"laser wavelength": conditions.wavelength_ppm, "air index": conditions.index_ppm}
    return [Line(name, "B", "rectangular", "ppm", 0.0, w / 3**0.5, 1e-6 * scale) for name, w in widths.items()]


def _budget(task: Task, worst: int, lines: list[Line], correlation: Floats) -> Budget:
    """The budget of lines of which the first have correlations."""
    full = np.eye(len(lines))
    full[: len(correlation), : len(correlation)] = correlation
    # The interval of the sum is drawn (JCGM 101); inputs that are not normal are independent of all others.
    random = np.random.default_rng(0)
    normal = np.array([line.contribution if line.distribution == "normal" else 0.0 for line in lines])
    total = random.standard_normal((_DRAWS, len(lines))) @ (covariance_root(full).T @ normal)
    for line in lines:
        if line.distribution == "rectangular":
            total += 3**0.5 * line.contribution * random.uniform(-1.0, 1.0, _DRAWS)
    low, high = quantile_band(total, COVERAGE).tolist()
    return Budget(task.name, float(task.along[worst]), task.unit, tuple(lines), full, (low, high))


def _posterior_lines(estimate: Estimate, row: Floats) -> tuple[list[Line], Floats]:
    """Parameters by block as the estimate has them, with the correlations of their contributions."""
    blocks = kinds(estimate.parameters)
    parts = np.zeros((len(blocks), len(row)))
    for k, (_, members) in enumerate(blocks):
        parts[k, members] = row[members]
    joint = parts @ estimate.covariance @ parts.T
    sd = np.sqrt(np.clip(np.diag(joint), 0.0, None))
    safe = np.where(sd > 0, sd, 1.0)
    correlation = joint / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    lines = [Line(name, "A, B", "normal", "um", 0.0, float(sd[k]), 1.0) for k, (name, _) in enumerate(blocks)]
    return lines, correlation


def _joint_lines(estimate: Estimate, model: CavityModel, task: Task, worst: int) -> list[Line]:
    """Repeatability and resolution of the joints at the aligned pose and at the worst point."""
    slopes = model.joint_jacobian(estimate.values, np.array([task.start, task.q[worst]]))
    sensitivity = np.hypot(slopes[0], slopes[1])
    units = np.where(model.cell.revolute, "rad", "um").tolist()
    # Half a step is the half width of the distribution of a resolution.
    kinds = (
        ("repeatability", "normal", model.cell.repeatability),
        ("resolution", "rectangular", model.cell.resolution / 12**0.5),
    )
    return [
        Line(f"{kind} of q{i + 1}", "B", distribution, units[i], 0.0, float(size), float(sensitivity[i]))
        for kind, distribution, sizes in kinds
        for i, size in enumerate(sizes)
        if size > 0
    ]
