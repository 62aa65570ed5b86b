"""Plan sweeps: the best of a number, or the fewest that reach a target."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.errors import InputError
from fpcal_bayes.infer.planning.candidates import candidate_sweeps, neighbours, reverses
from fpcal_bayes.infer.planning.choose import ChosenSweeps, chosen_sweeps, reference_of
from fpcal_bayes.infer.planning.criteria import Criterion, criterion_by_name
from fpcal_bayes.infer.planning.descend import descend
from fpcal_bayes.infer.planning.design import Design
from fpcal_bayes.infer.planning.exchange import exchange, greedy, most_useful_first
from fpcal_bayes.infer.planning.ground import Ground
from fpcal_bayes.infer.planning.limits import SweepLimits
from fpcal_bayes.infer.planning.refine import WIDTHS, refine
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class PlanSettings:
    """How a plan is searched.

    Attributes
    ----------
    readings
        Readings of each sweep after its start: 1 end point, 2 midpoint and end point, and so on.
    sigma
        Standard deviation of a row in um.
    criterion
        One of `CRITERIA`.
    n_candidates
        Random sweeps to choose from.
    share
        Draws that one start of the search is averaged over; there are as many starts as the draws give shares, and
        the best of them is refined over all draws.
    passes
        Passes of the exchange.
    variations
        Variations of each chosen sweep in a round of refinement.
    iterations
        Steps of the descent at the end; 0 of both keeps to the candidates.
    several
        Also move several joints of one controller at once.
    seed
        Of candidates and variations.
    limits
        Of the sweeps.
    """

    readings: int = 2
    sigma: float = 0.005
    criterion: str = "worst"
    n_candidates: int = 2000
    share: int = 16
    passes: int = 1
    variations: int = 30
    iterations: int = 100
    several: bool = True
    seed: int = 0
    limits: SweepLimits = field(default_factory=SweepLimits)


class Planner:
    """Searches for plans on one ground.

    Parameters
    ----------
    ground
        What is known, and the tasks.
    settings
        How to search.
    tolerances
        Standard deviation that each task is judged by, in um; by default all alike.

    Raises
    ------
    InputError
        If a setting cannot be, a tolerance is of an unknown task, or the limits leave no room for sweeps.
    """

    def __init__(
        self, ground: Ground, settings: PlanSettings | None = None, tolerances: Mapping[str, float] | None = None
    ) -> None:
        self.ground = ground
        self.settings = settings = PlanSettings() if settings is None else settings
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
        """The best n sweeps that are found: greedy start, exchange among the candidates, refinement, descent.

        Raises
        ------
        InputError
            If n is not between 1 and the number of candidates.
        """
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
        exist that the search does not find.

        Parameters
        ----------
        check
            Where the target is to be met, such as other draws of the prior; by default the planner's own ground.

        Raises
        ------
        InputError
            If no number up to `most` does; the message says the best.
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
