"""Descent: the ends of all chosen sweeps move together down the slope of the criterion, within the limits."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from scipy import optimize

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.infer.design.candidates import (
    SweepLimits,
    can_be_followed,
    controllers,
    long_enough,
    tilts,
    visible_ranges,
)
from fpcal_bayes.infer.design.information import Criterion
from fpcal_bayes.infer.design.rows import SweepRows
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cavity import CavityModel

#: Step of differences, as a share of a joint's range: derivatives are good to about five digits.
_STEP = 1e-6
#: Share of the tilt limit that the descent keeps clear of it: the optimiser keeps to constraints only nearly.
_MARGIN = 1e-4
#: Where the optimiser left the limits after all, an end goes back this share of its way.
_BACK = (0.0, 1e-3, 1e-2, 0.1, 0.5)
_LEAST_GAIN = 1e-4
#: Sweeps that descend together.
_TOGETHER = 20


def descend(
    sweeps: Sweeps,
    judge: Callable[[Sweeps], Criterion],
    made: SweepRows,
    values: Floats,
    limits: SweepLimits,
    *,
    several: bool = True,
    iterations: int = 100,
    tell: Callable[[float], None] = lambda _: None,
) -> Sweeps:
    """Move the ends of all sweeps together to where the criterion is smallest nearby; those given if nothing is gained.

    Sequential quadratic programming (SLSQP, Kraft 1988) within the joints' ranges and the tilt at the ends; large plans
    in parts of `iterations` each, for its time grows with the cube of their size. `judge` gives the criterion over
    candidates, whose rows `made` makes; what can be followed is judged at `values` (n_free,) of the free parameters.
    With `several` all joints of a controller may move that moves one, else only those that move.
    """
    if iterations < 1:
        return sweeps
    everyone = np.arange(len(sweeps))
    parts = np.array_split(everyone, -(-len(sweeps) // _TOGETHER))
    for number, part in enumerate(parts):

        def step(taken: int, number: int = number) -> None:
            tell((number + min(1.0, taken / iterations)) / len(parts))

        space = _Space.of(sweeps.take(part), CavityModel.of(made.model.cell), values, limits, several)
        moved = _part_descended(space, sweeps.take(np.setdiff1d(everyone, part)), judge, made, limits, iterations, step)
        q_start, q_end = sweeps.q_start.copy(), sweeps.q_end.copy()
        q_start[part], q_end[part] = moved.q_start, moved.q_end
        sweeps = replace(sweeps, q_start=q_start, q_end=q_end)
    return sweeps


def _part_descended(
    space: "_Space",
    others: Sweeps,
    judge: Callable[[Sweeps], Criterion],
    made: SweepRows,
    limits: SweepLimits,
    iterations: int,
    tell: Callable[[int], None],
) -> Sweeps:
    """The sweeps of a space after their descent beside others that stay."""
    n = len(space.plan)
    chosen = range(n + len(others))

    def criterion_at(sweeps: Sweeps) -> Criterion:
        return judge(join([sweeps, others], "descent") if len(others) else sweeps)

    begun = criterion_at(space.plan)
    first = begun.value(chosen)
    if not first or not space.sweep_of.size:
        return space.plan
    last: tuple[bytes, Criterion] = np.clip(space.at(space.plan), 0.0, 1.0).tobytes(), begun

    def at(x: Floats) -> Criterion:
        # The slope is asked for where the value was.
        nonlocal last
        if last[0] != x.tobytes():
            last = x.tobytes(), criterion_at(space.sweeps(x))
        return last[1]

    steps = count(1)

    def value(x: Floats) -> float:
        return at(x).value(chosen) / abs(first)

    def slope(x: Floats) -> Floats:
        by_rows = at(x).slope(chosen)[:, :n, :, : made.root.shape[1]]
        return space.slope(made.slope(space.sweeps(x), by_rows, space.steps)) / abs(first)

    visible = optimize.NonlinearConstraint(
        lambda x: space.tilts(space.sweeps(x)) / limits.tilt,
        -np.inf,
        1.0 - _MARGIN,
        jac=lambda x: space.tilt_slopes(x) / limits.tilt,
    )
    found = optimize.minimize(
        value,
        np.clip(space.at(space.plan), 0.0, 1.0),
        jac=slope,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * space.sweep_of.size,
        constraints=visible,
        callback=lambda _: tell(next(steps)),
        options={"maxiter": iterations, "ftol": _LEAST_GAIN},
    )
    better = _followed(space.plan, space.sweeps(found.x), space, limits)
    return better if criterion_at(better).value(chosen) < first else space.plan


@dataclass(frozen=True)
class _Space:
    """Coordinates of a plan: the ends of its sweeps as shares of the joints' ranges."""

    plan: Sweeps  # the sweeps at the start; joints that the coordinates leave alone stay there
    model: CavityModel
    values: Floats
    low: Floats
    width: Floats
    moving: Bools  # joints that move, shape (n_sweeps, n_joints); the others stand at the same place at both ends
    # sweep_of, end_of, joint_of: what each coordinate says: sweep, end (0 start, 1 end) and joint, shape
    # (n_coordinates,) each
    sweep_of: Ints
    end_of: Ints
    joint_of: Ints

    @classmethod
    def of(cls, plan: Sweeps, model: CavityModel, values: Floats, limits: SweepLimits, several: bool) -> "_Space":
        low, high = visible_ranges(model, values, limits)
        moving = plan.q_start != plan.q_end
        if several:
            for group in controllers(model.cell):
                moving[:, group] |= moving[:, group].any(axis=1, keepdims=True)
        moving &= high > low
        free = np.stack([np.broadcast_to(high > low, moving.shape), moving], axis=1)
        return cls(plan, model, values, low, high - low, moving, *np.nonzero(free))

    def at(self, sweeps: Sweeps) -> Floats:
        """Coordinates of sweeps, shape (n_coordinates,)."""
        joints = np.stack([sweeps.q_start, sweeps.q_end], axis=1)[self.sweep_of, self.end_of, self.joint_of]
        return (joints - self.low[self.joint_of]) / self.width[self.joint_of]

    def sweeps(self, x: Floats) -> Sweeps:
        """The plan at coordinates."""
        ends = np.stack([self.plan.q_start, self.plan.q_end], axis=1)
        ends[self.sweep_of, self.end_of, self.joint_of] = self.low[self.joint_of] + x * self.width[self.joint_of]
        return replace(self.plan, q_start=ends[:, 0], q_end=np.where(self.moving, ends[:, 1], ends[:, 0]))

    @property
    def steps(self) -> Floats:
        """Steps of differences, shape (n_joints,); joints without room stay, whatever theirs."""
        return _STEP * np.where(self.width > 0, self.width, 1.0)

    def slope(self, by_ends: Floats) -> Floats:
        """Derivatives by the coordinates from those by the ends (2, n_sweeps, n_joints), shape (n_coordinates,)."""
        start = np.where(self.moving, by_ends[0], by_ends.sum(axis=0))
        return np.stack([start, by_ends[1]])[self.end_of, self.sweep_of, self.joint_of] * self.width[self.joint_of]

    def tilts(self, sweeps: Sweeps) -> Floats:
        """Tilt of the mirror at the starts, then at the ends, in rad, shape (2 n,)."""
        return tilts(self.model, self.values, np.concatenate([sweeps.q_start, sweeps.q_end]))

    def tilt_slopes(self, x: Floats) -> Floats:
        """Derivatives of the tilts by the coordinates, shape (2 n_sweeps, n_coordinates)."""
        sweeps, n_joints = self.sweeps(x), len(self.width)
        further = np.stack([sweeps.q_start, sweeps.q_end])[:, :, None] + np.eye(n_joints + 1, n_joints, -1) * self.steps
        found = tilts(self.model, self.values, further.reshape(-1, n_joints)).reshape(*further.shape[:3])
        by_joint = (found[..., 1:] - found[..., :1]) / _STEP
        slopes = np.zeros((2, len(self.plan), x.size))
        each = np.arange(x.size)
        slopes[self.end_of, self.sweep_of, each] = by_joint[self.end_of, self.sweep_of, self.joint_of]
        still = ~self.moving[self.sweep_of, self.joint_of]
        slopes[1, self.sweep_of[still], each[still]] = by_joint[1, self.sweep_of[still], self.joint_of[still]]
        return slopes.reshape(-1, x.size)


def _followed(before: Sweeps, after: Sweeps, space: _Space, limits: SweepLimits) -> Sweeps:
    """The sweeps after the descent, each taken back as far as it must to be followed, at worst to where it was."""
    start, end, open_ = before.q_start.copy(), before.q_end.copy(), np.ones(len(before), dtype=bool)
    for share in _BACK:
        first = after.q_start + share * (before.q_start - after.q_start)
        last = after.q_end + share * (before.q_end - after.q_end)
        good = can_be_followed(space.model, space.values, first, last, limits)
        good &= open_ & long_enough(last - first, space.width)
        start[good], end[good] = first[good], last[good]
        open_ &= ~good
    return replace(before, q_start=start, q_end=end)
