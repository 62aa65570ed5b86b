"""Plan sweeps: the best of a number, or the fewest that reach a target."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import covariance_root
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.infer.design.candidates import SweepLimits, candidate_sweeps, neighbours, reverses
from fpcal_bayes.infer.design.criteria import Criterion, criterion_by_name
from fpcal_bayes.infer.design.descend import descend
from fpcal_bayes.infer.design.exchange import (
    WIDTHS,
    ChosenSweeps,
    chosen_sweeps,
    exchange,
    greedy,
    most_useful_first,
    reference_of,
    refine,
)
from fpcal_bayes.infer.design.information import Design
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS, Ground, estimate_ground, prior_ground
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import require_within_envelope
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.joint_path import travel_seconds

#: A task is left undetermined if more than this share of its standard deviation is left.
LEFT_SHARE = 0.1
_NAMED = 3


def shortfalls(ground: Ground, sweeps: Sweeps, *, readings: int = 2, sigma: float = 0.005) -> list[str]:
    """A sentence for each task that the sweeps leave undetermined, with the parameters that make it so."""
    design = ground.design(sweeps, readings=readings, sigma=sigma)
    before, after = design.expected_variance(()), design.expected_variance(range(len(sweeps)))
    variance, roots = design.task_variance(range(len(sweeps))), design.roots(range(len(sweeps)))
    root = covariance_root(ground.covariance, eigh=linalg.eigh)
    own = np.sqrt(np.diag(ground.covariance))
    safe = np.where(own > 0, own, 1.0)
    sentences = []
    for task, name in enumerate(design.names):
        if after[task] <= LEFT_SHARE**2 * before[task]:
            continue
        of_task = np.flatnonzero(design.task_of_point == task)
        draw, place = np.unravel_index(np.argmax(variance[:, of_task]), (len(variance), len(of_task)))
        # The way the parameters move when the error at this point is one standard deviation.
        point = design.tasks[draw, of_task[place]] @ roots[draw]
        direction = (root @ (roots[draw] @ point)) / safe / np.linalg.norm(point)
        names = [ground.model.free.names[i] for i in np.argsort(-np.abs(direction), kind="stable")[:_NAMED]]
        plural = "s leave" if len(sweeps) > 1 else " leaves"
        sentences.append(
            f"{len(sweeps)} sweep{plural} task {name} undetermined: {1e3 * np.sqrt(after[task]):.3g} nm expected, "
            f"{1e3 * np.sqrt(before[task]):.3g} nm before; what is missing moves {', '.join(names)}"
        )
    return sentences


def in_short_order(cell: Cell, sweeps: Sweeps) -> Sweeps:
    """Sweeps of a plan ordered and turned round such that the way between them is short.

    A sweep tells the same from either end. From joint vector zero the nearest end is taken each time; then parts of the
    way are turned round while that shortens it (2-opt, Croes 1958).
    """
    ends = np.stack([sweeps.q_start, sweeps.q_end])
    order, turned = _nearest(cell, ends)
    while True:
        first, last = ends[turned, order], ends[1 - turned, order]
        before = np.vstack([np.zeros((1, ends.shape[2])), last[:-1]])
        # Turning round sweeps i to j replaces the way into i and the way out of j; nothing follows the last.
        into = travel_seconds(cell, first - before)
        out = np.append(into[1:], 0.0)
        to_last = travel_seconds(cell, last[None, :] - before[:, None])
        from_first = travel_seconds(cell, first[:, None] - np.vstack([first[1:], first[:1]])[None, :])
        from_first[:, -1] = 0.0
        change = np.where(np.tri(len(order), dtype=bool).T, to_last + from_first - into[:, None] - out[None, :], 0.0)
        i, j = (int(k) for k in np.unravel_index(np.argmin(change), change.shape))
        if change[i, j] > -1e-9:
            break
        order[i : j + 1], turned[i : j + 1] = order[i : j + 1][::-1].copy(), 1 - turned[i : j + 1][::-1]
    ordered = sweeps.take(order)
    return Sweeps.of_um_rad(
        ends[turned, order], ends[1 - turned, order], label=ordered.label.tolist(), file=sweeps.file
    )


def in_safe_order(ground: Ground, sweeps: Sweeps, file: object = "plan") -> Sweeps:
    """Sweeps `in_short_order`; `InputError` if one of them, or a way between them, may leave the cell's envelope."""
    ordered = in_short_order(ground.cell, sweeps)
    require_within_envelope(ground.model, ground.draws, ordered.q_start, ordered.q_end, file=file)
    return ordered


def duration(cell: Cell, sweeps: Sweeps, readings: int, limits: SweepLimits) -> float:
    """Seconds from joint vector zero through all sweeps in their order: ways, sweeps, and settling at each reading."""
    before = np.vstack([np.zeros((1, len(cell.joints))), sweeps.q_end[:-1]])
    moving = travel_seconds(cell, sweeps.q_start - before) + travel_seconds(cell, sweeps.q_end - sweeps.q_start)
    return float(moving.sum() + limits.settling * (1 + readings) * len(sweeps))


def _nearest(cell: Cell, ends: Floats) -> tuple[Ints, Ints]:
    """Sweeps taken from the nearest end each time: their order, and whether each is turned round."""
    n = ends.shape[1]
    order, turned, left = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.ones(n, dtype=bool)
    here = np.zeros(ends.shape[2])
    for step in range(n):
        ways = np.where(left, travel_seconds(cell, ends - here), np.inf)
        side, sweep = (int(k) for k in np.unravel_index(np.argmin(ways), ways.shape))
        order[step], turned[step], left[sweep] = sweep, side, False
        here = ends[1 - side, sweep]
    return order, turned


@dataclass(frozen=True)
class PlanSettings:
    """How a plan is searched."""

    readings: int = 2  # readings of each sweep after its start: 1 end point, 2 midpoint and end point, and so on
    sigma: float = 0.005  # standard deviation of a row in um
    criterion: str = "worst"  # one of `CRITERIA`
    n_candidates: int = 2000  # random sweeps to choose from
    # draws that one start of the search is averaged over; there are as many starts as the draws give shares, and the
    # best of them is refined over all draws
    share: int = 16
    passes: int = 1  # passes of the exchange
    variations: int = 30  # variations of each chosen sweep in a round of refinement
    iterations: int = 100  # steps of the descent at the end; 0 of both keeps to the candidates
    several: bool = True  # also move several joints of one controller at once
    seed: int = 0
    limits: SweepLimits = field(default_factory=SweepLimits)  # the planner holds them to the cell's envelope


class Planner:
    """Searches for plans on one ground.

    Each task is judged by its standard deviation over that in `tolerances`, in um, by default all alike.
    """

    def __init__(
        self, ground: Ground, settings: PlanSettings | None = None, tolerances: Mapping[str, float] | None = None
    ) -> None:
        self.ground = ground
        settings = PlanSettings() if settings is None else settings
        limits = settings.limits.within_envelope(ground.model, ground.draws)
        self.settings = settings = replace(settings, limits=limits)
        self.reference = reference_of(tuple(ground.goals.jacobians), tolerances)
        self.candidates = candidate_sweeps(
            ground.cell,
            n=settings.n_candidates,
            rng=np.random.default_rng(settings.seed),
            values=self._centre,
            limits=settings.limits,
            several=settings.several,
        )
        n_draws = len(ground.goals.values)
        starts = max(1, n_draws // settings.share)
        self._parts = [ground.at_draws(np.arange(first, n_draws, starts)) for first in range(starts)]
        self._criteria = [self.judge(self.candidates, part) for part in self._parts]

    @property
    def _centre(self) -> Floats:
        """Values of the cell's own free parameters at which visibility is judged."""
        vector = self.ground.model.vector(self.ground.centre)
        return vector[self.ground.cell.free.slots]

    def judge(self, sweeps: Sweeps, ground: Ground | None = None) -> Criterion:
        """The criterion over sweeps as candidates, by default over all draws; what reverses counts less."""
        settings, ground = self.settings, self.ground if ground is None else ground
        design = ground.design(sweeps, readings=settings.readings, sigma=settings.sigma)
        if settings.limits.reversal_variance != 1.0:
            weight = np.where(
                reverses(ground.model, ground.goals.values, sweeps), settings.limits.reversal_variance**-0.5, 1.0
            )
            design = replace(design, rows=design.rows * weight[:, :, None, None])
        return criterion_by_name(settings.criterion, design, self.reference)

    def best(self, n: int) -> ChosenSweeps:
        """The best n sweeps that are found: greedy start, exchange among the candidates, refinement, descent."""
        if not 1 <= n <= len(self.candidates):
            raise InputError(
                f"{n} sweeps out of {len(self.candidates)} candidates: expected 1 to {len(self.candidates)}"
            )
        found = []
        for part, criterion in zip(self._parts, self._criteria, strict=True):
            chosen = exchange(criterion, greedy(criterion, n), passes=self.settings.passes)
            found.append(self._vary(self.candidates.take(np.array(chosen)), part, WIDTHS[::2]))
        if len(found) == 1:
            return self._finished(self._descended(found[0]))
        values = [self.judge(plan).value(range(n)) for plan in found]
        return self.refined(found[int(np.argmin(values))])

    def refined(self, sweeps: Sweeps) -> ChosenSweeps:
        """Sweeps after refinement and descent over all draws, the most useful first."""
        return self._finished(self._descended(self._vary(sweeps, self.ground, WIDTHS)))

    def _descended(self, sweeps: Sweeps) -> Sweeps:
        settings, cell = self.settings, self.ground.cell
        return descend(
            sweeps,
            self.judge,
            CavityModel.of(cell),
            self._centre,
            settings.limits,
            several=settings.several,
            iterations=settings.iterations,
        )

    def _vary(self, sweeps: Sweeps, ground: Ground, widths: tuple[float, ...]) -> Sweeps:
        settings = self.settings
        if not settings.variations:
            return sweeps
        rng = np.random.default_rng([settings.seed, len(sweeps)])

        def vary(chosen: Sweeps, width: float) -> tuple[Sweeps, Ints]:
            return neighbours(
                ground.cell,
                chosen,
                n_each=settings.variations,
                width=width,
                rng=rng,
                values=self._centre,
                limits=settings.limits,
            )

        return refine(sweeps, vary, lambda pool: self.judge(pool, ground), widths=widths)

    def _finished(self, sweeps: Sweeps) -> ChosenSweeps:
        judge = self.judge(sweeps)
        order = most_useful_first(judge, tuple(range(len(sweeps))))
        return chosen_sweeps(self._plain_design(sweeps), sweeps, order)

    def _plain_design(self, sweeps: Sweeps) -> Design:
        """Sweeps as candidates without any penalty, for figures that are reported."""
        return self.ground.design(sweeps, readings=self.settings.readings, sigma=self.settings.sigma)

    def excess(self, sd: Mapping[str, float]) -> float:
        """The largest ratio of a task's standard deviation to what it is judged by."""
        return max(
            sd[name] / float(limit) for name, limit in zip(self.ground.goals.jacobians, self.reference, strict=True)
        )

    def fewest(self, *, most: int = 69, check: Ground | None = None) -> ChosenSweeps:
        """The fewest sweeps, up to `most`, whose expected standard deviations keep to the tolerances.

        Numbers are halved between one that a greedy search shows to be enough and one that is not; a smaller plan may
        exist that the search does not find. The target is to be met on the ground `check`, such as other draws of the
        prior, by default the planner's own. `InputError` says the best if no number up to `most` meets it.
        """
        check = self.ground if check is None else check
        readings, sigma = self.settings.readings, self.settings.sigma

        def enough(plan: Sweeps) -> bool:
            return self.excess(check.expected_sd(plan, readings=readings, sigma=sigma)) <= 1.0

        chosen: tuple[int, ...] = ()
        while len(chosen) < most:
            chosen = greedy(self._criteria[0], len(chosen) + 1, chosen)
            if enough(self.candidates.take(np.array(chosen))):
                break
        best = self.refined(self.candidates.take(np.array(chosen)))
        if not enough(best.sweeps):
            raise self._unreached(len(chosen), check.expected_sd(best.sweeps, readings=readings, sigma=sigma))
        too_few, high = 0, len(chosen)
        while high - too_few > 1:
            middle = (too_few + high) // 2
            plan = self.best(middle)
            if enough(plan.sweeps):
                best, high = plan, middle
            else:
                too_few = middle
        return best

    def _unreached(self, n: int, sd: Mapping[str, float]) -> InputError:
        missed = [
            f"{name} {1e3 * sd[name]:.3g} nm in place of {1e3 * limit:.3g} nm"
            for name, limit in zip(self.ground.goals.jacobians, self.reference, strict=True)
            if sd[name] > limit
        ]
        return InputError(f"no plan of up to {n} sweeps reaches the target; the best has {', '.join(missed)}")


def plan(
    cell: Cell,
    n: int,
    *,
    estimate: Estimate | None = None,
    tasks: Sequence[str] = DEFAULT_TASKS,
    radius_um: float | None = None,
    readings: int = 2,
    sigma_nm: float = 5.0,
    draws: int = 64,
    seed: int = 0,
) -> Sweeps:
    """The n sweeps that are expected to leave least unknown of the tasks, in the order in which they are made fastest.

    Parameters
    ----------
    cell
        The cell that is to be measured.
    n
        How many sweeps.
    estimate
        What is known of the cell; by default its prior, averaged over `draws` draws of it.
    tasks, radius_um
        Tasks that count, and the radius of the circle (by default see `default_radius`).
    readings
        Readings of each sweep after its start.
    sigma_nm
        Standard deviation of each change of cavity length.
    seed
        The seed of numpy's default generator.

    Raises
    ------
    InputError
        If the estimate is not to be used, a task is unknown or out of reach, `n` is not possible, or sweeps may leave
        the cell's envelope.
    """
    if estimate is not None and not estimate.trust.usable:
        raise InputError(f"nothing is planned from this estimate: {estimate.trust.against}")
    settings = PlanSettings(readings=readings, sigma=1e-3 * sigma_nm, seed=seed)
    if estimate is None:
        ground = prior_ground(cell, tasks=tasks, radius=radius_um, draws=draws, seed=seed)
    else:
        ground = estimate_ground(estimate, tasks=tasks, radius=radius_um)
    return in_safe_order(ground, Planner(ground, settings).best(n).sweeps)
