"""What a plan starts from: what is known of the cell, where that is linearised, and the tasks that count."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.stats import qmc

from fpcal_bayes.core.errors import InputError, UnreachableError
from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.candidates import SweepLimits, candidate_sweeps
from fpcal_bayes.infer.design.information import Design
from fpcal_bayes.infer.design.machine import Machine, motions_of_path, prior_machine
from fpcal_bayes.infer.design.rows import TRACE_PLACES, TRACE_READINGS, SweepRows, plan_rows
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.measure.protocol import read_often, seen_by_all
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.margin import normal_draws
from fpcal_bayes.model.mechanics import Terms
from fpcal_bayes.motion.placement import Placement
from fpcal_bayes.motion.tasks import Task, default_radius, find_task

#: Tasks that a plan serves unless others are named.
DEFAULT_TASKS = ("circle", "tilt-x", "tilt-z", "spin")
#: Points of a task's path at which plans are compared.
POINTS = 9
#: A task is left undetermined if more than this share of its standard deviation is left; parameters that are named.
_LEFT_SHARE, _NAMED = 0.1, 3
#: Sweeps that tell which combinations of error motions are felt at all.
_FELT = 400


@dataclass(frozen=True)
class Goals:
    """Tasks at draws of the parameters."""

    # free parameters of the draws at which every task can be driven to, shape (n_draws, n_free), in um and rad
    values: Floats
    # derivatives of each task's points by the free parameters, shape (n_draws, n_points, n_free)
    jacobians: dict[str, Floats]
    dropped: int  # draws that were left out since a task has no point that can be driven to
    # what weights of error motions, and last what no sweep can tell, add to the points, (n_draws, n_points, n_weights)
    motions: dict[str, Floats]
    reach: Floats  # lowest and highest value of each joint on the paths, middle over the draws, shape (2, n_joints)


def goals_of(
    model: CavityModel,
    values: Floats,
    tasks: Sequence[str],
    *,
    radius: float | None = None,
    points: int = POINTS,
    terms: Terms | None = None,
) -> Goals:
    """The tasks, names or path files, at each draw, as a controller with these parameters would drive them.

    `values` (n_draws, n_free) are in um and rad. Points that cannot be driven to are replaced by the nearest on the
    path that can, so that every draw has as many. `InputError` if a task is unknown, or there is no draw at which all
    of them can be driven to.
    """
    tasks = tuple(dict.fromkeys(tasks))
    if not tasks:
        raise InputError("no task to plan for: expected one at least")
    radius = default_radius(model.cell) if radius is None else radius
    kept: list[int] = []
    found: dict[str, list[tuple[Floats, Floats, Floats]]] = {task: [] for task in tasks}
    reason = ""
    for number, point in enumerate(values):
        try:
            vector = model.vector(point)
            at = Placement.of(model.cell, vector)
            paths = [_points_of(find_task(model.cell, vector, task, radius, points, at)) for task in tasks]
        except UnreachableError as error:
            reason = str(error)
            continue
        kept.append(number)
        for task, part in zip(tasks, _at(model, point, paths, terms), strict=True):
            found[task].append(part)
    if not kept:
        raise InputError(f"{reason}: expected tasks that the cell can drive")
    jacobians, motions = ({task: np.array([p[i] for p in each]) for task, each in found.items()} for i in (0, 1))
    reach = np.array([[part[2] for part in each] for each in found.values()])
    ends = np.stack([reach[:, :, 0].min(axis=0), reach[:, :, 1].max(axis=0)])
    return Goals(values[kept], jacobians, len(values) - len(kept), motions, np.median(ends, axis=1))


def _points_of(task: Task) -> Task:
    """A task's points that can be driven to, the nearest in place of those that cannot."""
    if not task.ok.any() or not np.isfinite(task.start).all():
        raise UnreachableError(f"task {task.name!r}: no point can be driven to; point 1: {task.status[0]}")
    good = np.flatnonzero(task.ok)
    return task.take(good[np.abs(np.arange(len(task))[:, None] - good).argmin(axis=1)])


def _at(
    model: CavityModel, values: Floats, paths: Sequence[Task], terms: Terms | None
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Derivatives of each task's points by the free parameters, what error motions add, and the joints' reach."""
    starts = np.concatenate([np.repeat(task.start[None], len(task), axis=0) for task in paths])
    _, jacobian = model.predict_with_jacobian(values, model.rows(starts, np.concatenate([task.q for task in paths])))
    for task, part in zip(paths, np.split(jacobian, np.cumsum([len(task) for task in paths])[:-1]), strict=True):
        motions = np.zeros((len(task), 0))
        if terms is not None:
            told, untold = motions_of_path(terms, model.vector(values), task.start, task.q)
            motions = np.hstack([told, untold[:, None]])
        yield part, motions, np.stack([task.q.min(axis=0), task.q.max(axis=0)])


@dataclass(frozen=True)
class Ground:
    """Knowledge before the planned sweeps: a state of unit covariance, free parameters and error motions."""

    model: CavityModel  # model of the parameters that are not known exactly
    centre: Floats  # where visibility and fringe rate are judged, shape (n_free,), in um and rad
    covariance: Floats  # of the free parameters, shape (n_free, n_free), in um and rad
    goals: Goals  # the tasks, at the draws over which the plan is averaged
    machine: Machine | None = None  # error motions
    # whitened rows by the state of what is measured in any case, shape (n_draws, n_rows, n), or None
    known: Floats | None = None
    # from the state to the free parameters, shape (n_free, n), where knowledge of an estimate says it
    factor: Floats | None = None
    measured: bool = False  # whether what is known is told by sweeps that have just been measured

    @property
    def cell(self) -> Cell:
        """The cell that is planned for."""
        return self.model.cell

    @cached_property
    def draws(self) -> Floats:
        """Draws of what is known of the free parameters, shape (n_draws, n_free)."""
        return normal_draws(self.centre, self.covariance)

    @cached_property
    def root(self) -> Floats:
        """From the state to the free parameters, shape (n_free, n)."""
        if self.factor is not None:
            return self.factor
        own = np.diag(self.covariance)
        diagonal = np.count_nonzero(self.covariance) == np.count_nonzero(own)
        root: Floats = np.diag(np.sqrt(own)) if diagonal else covariance_root(self.covariance, eigh=linalg.eigh)
        more = 0 if self.machine is None else self.machine.basis.shape[1] - root.shape[1]
        return np.pad(root, ((0, 0), (0, more)))

    @cached_property
    def tasks(self) -> dict[str, Floats]:
        """Derivatives of each task's points by the state, shape (n_draws, n_points, n)."""
        found = {name: jacobian @ self.root for name, jacobian in self.goals.jacobians.items()}
        if self.machine is not None:
            for name, motions in self.goals.motions.items():
                found[name] = found[name] + motions[..., :-1] @ self.machine.basis
                # What no sweep tells is one more direction of the state.
                found[name] = np.concatenate([found[name], motions[..., -1:]], axis=2)
        return found

    def sweep_rows(self, readings: int, sigma: float) -> SweepRows:
        """What turns candidates into rows by the state; 0 `readings` are a whole trace."""
        if readings == 0:
            readings, sigma = TRACE_PLACES, sigma * float(np.sqrt((TRACE_PLACES + 1) / (TRACE_READINGS + 1)))
        return SweepRows(self.model, self.goals.values, self.centre, self.root, readings, sigma, self.machine)

    def design(self, sweeps: Sweeps, *, readings: int, sigma: float) -> Design:
        """The sweeps as candidates, each by itself."""
        return Design.of(self.padded(self.sweep_rows(readings, sigma).of(sweeps)), self.tasks, known=self.known)

    def padded(self, rows: Floats) -> Floats:
        """Rows with nothing of what no sweep tells."""
        return rows if self.machine is None else np.pad(rows, ((0, 0),) * (rows.ndim - 1) + ((0, 1),))

    def expected_sd(self, sweeps: Sweeps | None, *, readings: int = 2, sigma: float = 0.005) -> dict[str, float]:
        """Worst-point sd of each task in um over the draws, after a whole plan in its order, or None: without one."""
        each = self.sd_at_draws(sweeps, readings=readings, sigma=sigma)
        return {name: float(np.sqrt(np.mean(sd**2))) for name, sd in each.items()}

    def sd_at_draws(self, sweeps: Sweeps | None, *, readings: int = 2, sigma: float = 0.005) -> dict[str, Floats]:
        """Worst-point standard deviation of each task in um at each draw, shape (n_draws,) (see `expected_sd`)."""
        design = self.driven(sweeps, readings=readings, sigma=sigma)
        variance = design.task_variance(())
        of = design.task_of_point
        return {name: np.sqrt(variance[:, of == i].max(axis=1)) for i, name in enumerate(design.names)}

    def driven(self, sweeps: Sweeps | None, *, readings: int, sigma: float) -> Design:
        """What is left after sweeps in their order, with no candidates."""
        known = self.known
        if sweeps is not None:
            made = self.sweep_rows(readings, sigma)
            rows = self._rows(seen_by_all(read_often(sweeps, made.readings), self.cell), made.sigma)
            known = rows if known is None else np.concatenate([known, rows], axis=1)
        nothing = np.zeros((len(self.goals.values), 0, 1, next(iter(self.tasks.values())).shape[-1]))
        return Design.of(nothing, self.tasks, known=known)

    def _rows(self, sweeps: Sweeps, sigma: float) -> Floats:
        """Whitened rows by the state of sweeps in their order; `sigma` in um where they say none."""
        used = replace(sweeps, sigma=np.where(np.isfinite(sweeps.sigma), sweeps.sigma, sigma))
        if self.machine is None:
            return plan_rows(self.model, self.goals.values, used) @ self.root
        _, jacobian = self.model.predict_with_jacobian(self.goals.values, used.laid_out(self.model))
        return self.padded(self.machine.whitened(used, jacobian @ self.root))

    def at_draws(self, chosen: Ints) -> "Ground":
        """The same averaged over some of the draws, by position."""
        goals = self.goals
        jacobians, motions = ({k: v[chosen] for k, v in part.items()} for part in (goals.jacobians, goals.motions))
        goals = replace(goals, values=goals.values[chosen], jacobians=jacobians, motions=motions)
        return replace(self, goals=goals, known=None if self.known is None else self.known[chosen])

    def with_known(self, sweeps: Sweeps, sigma: float) -> "Ground":
        """The same with sweeps that are measured in any case; `sigma` in um where they say none."""
        return replace(self, known=self._rows(sweeps, sigma))


def prior_ground(
    cell: Cell,
    *,
    tasks: Sequence[str] = DEFAULT_TASKS,
    radius: float | None = None,
    draws: int = 64,
    points: int = POINTS,
    seed: int = 0,
    values: Floats | None = None,
) -> Ground:
    """A cell before its first calibration: averaged over `draws` of its prior (Sobol 1967), or `values`."""
    model, free = CavityModel.of(cell), cell.free
    if draws < 1:
        raise InputError(f"{draws} draws of what is known: expected one at least")
    if values is None:
        engine = qmc.MultivariateNormalQMC(np.zeros(len(free)), seed=np.random.default_rng(seed))
        # The sequence is balanced at powers of two; any number of draws serves here.
        values = Prior.of(free).values(engine.random(1 << (draws - 1).bit_length())[:draws])
    terms = None if cell.mechanics is None else Terms.of(cell, cell.mechanics, free.names)
    goals = goals_of(model, values, tasks, radius=radius, points=points, terms=terms)
    made = Ground(model, free.nominal, np.diag(free.prior_sd**2), goals)
    if terms is None:
        return made
    limits = SweepLimits().within_envelope(model, made.draws)
    some = candidate_sweeps(cell, n=_FELT, rng=np.random.default_rng(0), limits=limits)
    poses = np.stack([some.q_start, 0.5 * (some.q_start + some.q_end), some.q_end], axis=1)
    told = np.concatenate([np.concatenate(part[..., :-1]) for part in goals.motions.values()])
    return replace(made, machine=prior_machine(terms, cell.parameters.nominal, poses, told, len(free)))


def estimate_ground(
    estimate: Estimate, *, tasks: Sequence[str] = DEFAULT_TASKS, radius: float | None = None, points: int = POINTS
) -> Ground:
    """A cell of which there is an estimate: its values, and what it leaves unknown of parameters and error motions."""
    cell, known = estimate.cell, estimate.mechanics
    model = CavityModel.of(cell, estimate.parameters, estimate.vector())
    terms = None if known is None else known.terms(cell)
    goals = goals_of(model, estimate.values[None], tasks, radius=radius, points=points, terms=terms)
    made = Ground(model, estimate.values, estimate.covariance, goals)
    if known is None or terms is None:
        return made
    # Geometry and weights share the directions of the estimate; what drift has added since is new.
    _, geometry = known.geometry(estimate.parameters.names)
    later = covariance_root(np.asarray(estimate.covariance - geometry @ geometry.T), estimate.sd, eigh=linalg.eigh)
    names, _, factor = known.weights(known.n_parameters)
    shared = factor[[not name.startswith("drift along") for name in names]]
    basis = np.hstack([shared, np.zeros((len(shared), later.shape[1]))])
    return replace(made, machine=Machine(terms, estimate.vector(), basis), factor=np.hstack([geometry, later]))


def measured_estimate(cell: Cell, sweeps: Sweeps) -> Estimate:
    """What measured sweeps tell of a cell: where the best next ones are planned."""
    found = identify(cell, sweeps)
    if not found.converged:
        raise InputError(f"{sweeps.file}: the identification did not converge, expected sweeps that can be fitted")
    return found.estimate


def measured_ground(
    estimate: Estimate,
    sweeps: Sweeps,
    *,
    tasks: Sequence[str] = DEFAULT_TASKS,
    radius: float | None = None,
    draws: int = 64,
    seed: int = 0,
) -> Ground:
    """A cell after measured sweeps: these and the prior, at draws of the estimate, which counts with mechanics."""
    if estimate.mechanics is not None:
        return replace(estimate_ground(estimate, tasks=tasks, radius=radius), measured=True)
    values = normal_draws(estimate.values, estimate.covariance, draws, seed)
    made = prior_ground(estimate.cell, tasks=tasks, radius=radius, values=values)
    return replace(made, centre=estimate.values).with_known(sweeps, 0.0)


def shortfalls(ground: Ground, sweeps: Sweeps, *, readings: int = 2, sigma: float = 0.005) -> list[str]:
    """A sentence for each task that the sweeps leave undetermined, with the parameters that make it so."""
    last = ground.driven(sweeps, readings=readings, sigma=sigma)
    # Before any sweep: what measured ones have told is not undetermined since more add little.
    before = replace(ground, known=None).driven(None, readings=readings, sigma=sigma).expected_variance(())
    if ground.measured:
        wide = [jacobian * ground.model.free.prior_sd for jacobian in ground.goals.jacobians.values()]
        before = np.array([(jacobian**2).sum(axis=-1).max(axis=1).mean() for jacobian in wide])
    after, variance, roots = last.expected_variance(()), last.task_variance(()), last.roots(())
    own = np.sqrt(np.diag(ground.covariance))
    safe = np.where(own > 0, own, 1.0)
    sentences = []
    for task, name in enumerate(last.names):
        if after[task] <= _LEFT_SHARE**2 * before[task]:
            continue
        of_task = np.flatnonzero(last.task_of_point == task)
        draw, place = np.unravel_index(np.argmax(variance[:, of_task]), (len(variance), len(of_task)))
        # The way the parameters move when the error at this point is one standard deviation.
        point = last.tasks[draw, of_task[place]] @ roots[draw]
        direction = (ground.root @ (roots[draw] @ point)[: ground.root.shape[1]]) / safe / np.linalg.norm(point)
        names = [ground.model.free.names[i] for i in np.argsort(-np.abs(direction), kind="stable")[:_NAMED]]
        plural = "s leave" if len(sweeps) > 1 else " leaves"
        sentences.append(
            f"{len(sweeps)} sweep{plural} task {name} undetermined: {1e3 * np.sqrt(after[task]):.3g} nm expected, "
            f"{1e3 * np.sqrt(before[task]):.3g} nm before any; what is missing moves {', '.join(names)}"
        )
    return sentences
