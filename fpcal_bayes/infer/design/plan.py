"""Plan sweeps: the best of a number, or the fewest that reach a target."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.design.candidates import SweepLimits, candidate_sweeps
from fpcal_bayes.infer.design.descend import descend
from fpcal_bayes.infer.design.exchange import (
    ChosenSweeps,
    chosen_sweeps,
    exchange,
    greedy,
    most_useful_first,
    reference_of,
    require_possible,
)
from fpcal_bayes.infer.design.information import Criterion
from fpcal_bayes.infer.design.order import duration, in_short_order
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS, Ground, estimate_ground, prior_ground
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import require_within_envelope
from fpcal_bayes.model.estimate import Estimate

#: Least candidates of a start; how often each place of it is looked at; steps of its descent; by how much more draws
#: the plans that were found are judged and joined on.
_FEW, _PASSES, _STARTED, _WIDER = 300, 2, 20, 3
#: Plans whose sweeps are crossed, and starts and crossings of a short search.
_PARENTS, _SHORT = 4, (4, 1)
#: Draws that tell whether a sweep turns round for the sake of lost motion, and what it must gain.
_TURNED_DRAWS, _TURNED_GAIN = 4, 0.005
#: Numbers of sweeps on the frontier.
_NUMBERS = (4, 6, 8, 10, 12, 14, 16, 20, 24, 30)
#: Most readings of a sweep; sweeps of the first plan when time is given.
_MOST_READINGS, _FIRST = 100, 12


@dataclass(frozen=True)
class PlanSettings:
    """How a plan is searched."""

    # readings of each sweep after its start: 1 end point, 2 midpoint and end point, and so on; 0 the whole trace
    readings: int = 2
    sigma: float = 0.005  # standard deviation of a row in um
    n_candidates: int = 2000  # random sweeps to choose from
    # starts of the search and crossings of what these found, on `share` draws each, and steps of the descent over all
    # draws at the end; without these the search keeps to the candidates
    starts: int = 4
    crossings: int = 10
    share: int = 32
    iterations: int = 60
    several: bool = False  # also move several joints of one controller at once
    seed: int = 0
    limits: SweepLimits = field(default_factory=SweepLimits)  # the planner holds them to the cell's envelope

    def __post_init__(self) -> None:
        if not 0 <= self.readings <= _MOST_READINGS:
            raise InputError(f"{self.readings} readings of a sweep: expected 0, the whole trace, to {_MOST_READINGS}")
        if not 0 < self.sigma < np.inf:
            raise InputError(f"standard deviation {1e3 * self.sigma:g} nm of a reading: expected a number above zero")


@dataclass(frozen=True)
class Point:
    """A plan on the frontier: its sweeps, seconds, and expected standard deviation of each task in um."""

    sweeps: int
    seconds: float
    sd: Mapping[str, float]


@dataclass(frozen=True)
class Frontier:
    """Plans by rising number of sweeps, and the worst task of each over what it is judged by."""

    points: tuple[Point, ...]
    excess: tuple[float, ...]

    @property
    def knee(self) -> int:
        """Plan farthest below the line between the ends, both axes logarithmic (Satopaa et al. 2011)."""
        x, y = np.log([[float(point.sweeps) for point in self.points], self.excess])
        return int(np.argmax(np.interp(x, x[[0, -1]], y[[0, -1]]) - y))


class Planner:
    """Searches for plans on one ground, judged by `tolerances` in um; `tell` takes the share of work done."""

    def __init__(
        self,
        ground: Ground,
        settings: PlanSettings | None = None,
        tolerances: Mapping[str, float] | None = None,
        tell: Callable[[float], None] = lambda _: None,
    ) -> None:
        self.ground, self.tell = ground, tell
        self._singles: dict[int, ChosenSweeps] = {}
        settings = PlanSettings() if settings is None else settings
        self.settings = settings = replace(settings, limits=settings.limits.within_envelope(ground.model, ground.draws))
        self._tolerances = tolerances
        self.reference = reference_of(tuple(ground.goals.jacobians), tolerances)
        rng, limits, several = np.random.default_rng(settings.seed), settings.limits, settings.several
        self.candidates = candidate_sweeps(
            ground.cell, n=settings.n_candidates, rng=rng, values=self._centre, limits=limits, several=several
        )

    @property
    def _centre(self) -> Floats:
        """Values of the cell's own free parameters at which visibility is judged."""
        return self.ground.model.vector(self.ground.centre)[self.ground.cell.free.slots]

    def judge(self, sweeps: Sweeps, ground: Ground | None = None) -> Criterion:
        """The criterion over sweeps as candidates, by default over all draws."""
        design = (ground or self.ground).design(sweeps, readings=self.settings.readings, sigma=self.settings.sigma)
        return Criterion(design, self.reference)

    def left(self, sweeps: Sweeps, ground: Ground | None = None) -> dict[str, float]:
        """What sweeps in their order leave of each task, in um, by default where plans are made."""
        return (ground or self.ground).expected_sd(sweeps, readings=self.settings.readings, sigma=self.settings.sigma)

    def value(self, sweeps: Sweeps, ground: Ground | None = None) -> float:
        """The criterion after sweeps in their order."""
        design = (ground or self.ground).driven(sweeps, readings=self.settings.readings, sigma=self.settings.sigma)
        return Criterion(design, self.reference).value(())

    def best(self, n: int) -> ChosenSweeps:
        """The best n sweeps that are found: plans on few draws each, the best of them and all on more, then on all.

        Where joints may move together the plan of `single` joints is given if it leaves less on the draws planned for.
        """
        settings, n_draws = self.settings, len(self.ground.goals.values)
        require_possible(n, len(self.candidates))
        tries, alone = settings.starts + settings.crossings * bool(settings.iterations), sum(_SHORT) * settings.several
        # In descents of `_STARTED` steps on `share` draws.
        work = np.cumsum([alone, tries, 1.0 * _WIDER, settings.iterations / _STARTED * n_draws / settings.share])

        def begun(stage: int, share: float) -> None:
            self.tell(float(work[stage] + share * (work[stage + 1] - work[stage])) / float(work[-1]))

        single = self.single(n, lambda share: self.tell(share * alone / float(work[-1]))) if settings.several else None
        found: list[Sweeps] = []
        for number in range(tries):
            ground = self._part(number, settings.share)
            begin = self._crossed(n, found, ground) if number >= settings.starts else self._start(n, number)
            found.append(self._descended(begin, ground, _STARTED))
            begun(0, (number + 1) / tries)
        every = found if single is None else [*found, single.sweeps]
        best = self._joined(every, self._part(0, _WIDER * settings.share))
        begun(1, 1.0)
        return self._or_single(self.refined(best, lambda share: begun(2, share)))

    def _or_single(self, plan: ChosenSweeps) -> ChosenSweeps:
        # Draws that a plan is checked on take no part in this, else the figure there flatters the one that is taken.
        both = (self.single(len(plan)), plan) if self.settings.several else (plan,)
        return min(both, key=lambda one: self.excess(self.left(one.sweeps)))

    def single(self, n: int, tell: Callable[[float], None] = lambda _: None) -> ChosenSweeps:
        """The best n sweeps of single joints that a short search finds; searched once."""
        if n not in self._singles:
            self._singles[n] = self.short(False, tell).best(n)
        return self._singles[n]

    def _start(self, n: int, number: int) -> Sweeps:
        """The best of a part of the candidates: one by one, then each again beside the others."""
        count = min(max(n, len(self.candidates) // self.settings.starts, _FEW), len(self.candidates))
        random = np.random.default_rng([self.settings.seed, number])
        some = self.candidates.take(random.choice(len(self.candidates), count, replace=False))
        # Half of the draws tell enough of where a descent should start.
        return self._chosen(some, n, self._part(number, max(self.settings.share // 2, 1)))

    def _crossed(self, n: int, found: list[Sweeps], ground: Ground) -> Sweeps:
        """As a start, among the sweeps of the best of plans that were found."""
        values = [self.judge(plan, ground).value(range(n)) for plan in found]
        parents = [found[i] for i in np.argsort(values, kind="stable")[:_PARENTS]]
        return self._chosen(join(parents, "crossed"), n, ground)

    def _chosen(self, sweeps: Sweeps, n: int, ground: Ground) -> Sweeps:
        judge = self.judge(sweeps, ground)
        return sweeps.take(np.array(exchange(judge, greedy(judge, n), passes=_PASSES)))

    def _joined(self, found: list[Sweeps], ground: Ground) -> Sweeps:
        """The best plan with each of its sweeps exchanged for one of all plans."""
        n = len(found[0])
        best = int(np.argmin([self.judge(plan, ground).value(range(n)) for plan in found]))
        every = join(found, "joined")
        begun = tuple(range(n * best, n * (best + 1)))
        return every.take(np.array(exchange(self.judge(every, ground), begun, passes=_PASSES)))

    def _part(self, number: int, share: int) -> Ground:
        """The ground averaged over the draws of one start: neighbours in a quasi-random sequence fill the space."""
        n_draws = len(self.ground.goals.values)
        if share >= n_draws:
            return self.ground
        return self.ground.at_draws((number * share + np.arange(share)) % n_draws)

    def refined(self, sweeps: Sweeps, tell: Callable[[float], None] = lambda _: None) -> ChosenSweeps:
        """Sweeps after a descent over all draws, the most useful first."""
        sweeps = self._descended(sweeps, self.ground, self.settings.iterations, tell)
        judge = self.judge(sweeps)
        return chosen_sweeps(judge.design, sweeps, most_useful_first(judge, tuple(range(len(sweeps)))))

    def _descended(
        self, sweeps: Sweeps, ground: Ground, steps: int, tell: Callable[[float], None] = lambda _: None
    ) -> Sweeps:
        settings, judge = self.settings, partial(self.judge, ground=ground)
        rows, most = ground.sweep_rows(settings.readings, settings.sigma), min(steps, settings.iterations)
        space = self._centre, settings.limits
        return descend(sweeps, judge, rows, *space, several=settings.several, iterations=most, tell=tell)

    def in_order(self, sweeps: Sweeps, file: object = "plan") -> Sweeps:
        """Sweeps in a short order within the envelope; one turns round if lost motion then shows."""
        ordered = in_short_order(self.ground.cell, sweeps)
        if self.ground.machine is not None and len(self.ground.machine.reversing):
            few = self.ground.at_draws(np.arange(min(_TURNED_DRAWS, len(self.ground.goals.values))))
            best = self.value(ordered, few)
            for i in range(len(ordered)):
                start, end = ordered.q_start.copy(), ordered.q_end.copy()
                start[i], end[i] = ordered.q_end[i], ordered.q_start[i]
                turned = replace(ordered, q_start=start, q_end=end)
                found = self.value(turned, few)
                if found < best * (1.0 - _TURNED_GAIN):
                    ordered, best = turned, found
        require_within_envelope(self.ground.model, self.ground.draws, ordered.q_start, ordered.q_end, file=file)
        return ordered

    def within(self, seconds: float, most: int = 69) -> ChosenSweeps:
        """As many sweeps, up to `most`, as take no longer than `seconds` in their order; `InputError` if none does."""

        def spent(sweeps: Sweeps) -> float:
            return duration(self.ground.cell, self.in_order(sweeps), self.settings.readings, self.settings.limits)

        n, fits, too_many = min(most, _FIRST), 0, most + 1
        best = None
        while too_many - fits > 1:
            found = self.best(n)
            needed = left = spent(found.sweeps)
            if needed > seconds:
                too_many = n
            # Plans of nearly as many may take longer still: the least useful sweeps give way first.
            while left > seconds and len(found) > fits + 1:
                found = found.first(len(found) - 1)
                left = spent(found.sweeps)
            if left <= seconds:
                best, fits = found, len(found)
            # Time is nearly proportional to the number.
            n = int(np.clip(int(n * seconds / needed), fits + 1, too_many - 1))
        if best is None:
            raise InputError(f"{seconds / 60.0:g} min: not even one sweep takes as little")
        return best

    def short(self, several: bool, tell: Callable[[float], None] = lambda _: None) -> "Planner":
        """A planner that searches less, on fewer draws, for a comparison."""
        less = replace(self.settings, starts=_SHORT[0], crossings=_SHORT[1], several=several)
        return Planner(self._part(0, _WIDER * less.share), less, self._tolerances, tell)

    def frontier(self, check: Ground, most: int, tell: Callable[[float], None] = lambda _: None) -> "Frontier":
        """What plans of several numbers of sweeps, up to `most`, by short searches, leave on the ground `check`."""
        settings, short, points = self.settings, self.short(self.settings.several), []
        numbers = [n for n in _NUMBERS if n < most] + [most]
        for done, n in enumerate(numbers):
            plan = short.in_order(short.best(n).sweeps)
            seconds = duration(self.ground.cell, plan, settings.readings, settings.limits)
            points.append(Point(n, seconds, self.left(plan, check)))
            tell((done + 1) / len(numbers))
        return Frontier(tuple(points), tuple(self.excess(point.sd) for point in points))

    def should_stop(self, check: Ground) -> bool:
        """Whether what is known before any sweep keeps every task within its tolerance, on the ground `check`."""
        return self.excess(check.expected_sd(None)) <= 1.0

    def excess(self, sd: Mapping[str, float]) -> float:
        """The largest ratio of a task's standard deviation to what it is judged by."""
        return max(sd[name] / float(of) for name, of in zip(self.ground.goals.jacobians, self.reference, strict=True))

    def fewest(self, *, most: int = 69, check: Ground | None = None, settle: bool = False) -> ChosenSweeps:
        """The fewest up to `most` that keep to the tolerances on `check`; else `InputError`, or the best (`settle`)."""

        def enough(plan: Sweeps) -> bool:
            return self.excess(self.left(plan, check)) <= 1.0

        chosen: tuple[int, ...] = ()
        criterion = self.judge(self.candidates, self.ground.at_draws(np.arange(min(len(self.ground.goals.values), 16))))
        while len(chosen) < most:
            chosen = greedy(criterion, len(chosen) + 1, chosen)
            if enough(self.candidates.take(np.array(chosen))):
                break
        found = self.candidates.take(np.array(chosen))
        best = self.refined(found)
        if not enough(best.sweeps):
            # The descent heeds other draws: candidates that suffice stay a plan though it leads away from them.
            as_found = partial(chosen_sweeps, self.judge(found).design, found, tuple(range(len(found))))
            best = as_found() if enough(found) else self.best(len(found))
        if not enough(best.sweeps):
            if settle:
                return best
            raise InputError(self.unreached(self.left(best.sweeps, check), len(chosen)))
        too_few, high = 0, len(chosen)
        while high - too_few > 1:
            middle = (too_few + high) // 2
            plan = self.best(middle)
            if enough(plan.sweeps):
                best, high = plan, middle
            else:
                too_few = middle
        other = self._or_single(best)
        return other if enough(other.sweeps) else best

    def unreached(self, sd: Mapping[str, float], n: int) -> str:
        """A sentence on `n` sweeps, the best that are found, that leave each task `sd` in um and miss a tolerance."""
        missed = [
            f"{name} {1e3 * sd[name]:.3g} nm in place of {1e3 * limit:.3g} nm"
            for name, limit in zip(self.ground.goals.jacobians, self.reference, strict=True)
            if sd[name] > limit
        ]
        return f"no plan of up to {n} sweeps reaches the target; the best has {', '.join(missed)}"


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
    planner = Planner(ground, settings)
    return planner.in_order(planner.best(n).sweeps)
