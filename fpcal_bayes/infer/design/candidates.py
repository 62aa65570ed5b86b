"""Sweeps that could be measured: within the limits of the joints, of the visibility and of the fringe counter."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import safe_ranges
from fpcal_bayes.model.joint_path import travel_seconds


@dataclass(frozen=True)
class SweepLimits:
    """Bounds of candidate sweeps; lengths in um, angles in rad."""

    # largest angle between mirror normal and optical axis at which fringes are visible. The paper's sweeps reach 4.24
    # deg, with both goniometers at 3 deg.
    tilt: float = float(np.radians(4.3))
    fringe_rate: float = 1000.0  # fringes (changes of lambda/2) a second that can be counted
    settling: float = 1.0  # seconds to wait before a reading
    # free_travel, free_turn: how far a joint without limit is moved, to either side of zero
    free_travel: float = 150.0
    free_turn: float = float(np.radians(90.0))
    # lowest and highest value of each joint, within its limits, or None: those
    reach: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "reach" and not (np.isfinite(value) and (value >= 0 if name == "settling" else value > 0)):
                raise InputError(f"limit {name} of a sweep: expected a number above zero, found {value:g}")
        if self.tilt >= np.pi / 2:
            raise InputError(f"limit tilt of a sweep: expected less than 90 deg, found {np.degrees(self.tilt):g}")

    def within_envelope(self, model: CavityModel, draws: Floats) -> "SweepLimits":
        """The same such that sweeps and all ways between them stay in the envelope, at draws (n_draws, n_free)."""
        envelope = model.cell.envelope
        if envelope is None:
            return self
        low, high = safe_ranges(model, draws, *self.ranges(model.cell))
        return replace(
            self,
            tilt=min(self.tilt, envelope.max_tilt),
            fringe_rate=min(self.fringe_rate, envelope.max_fringe_rate),
            reach=(tuple(low.tolist()), tuple(high.tolist())),
        )

    def hold(self, sweeps: Sweeps) -> Bools:
        """Whether both ends of each sweep stay within `reach`, shape (n,)."""
        if self.reach is None:
            return np.ones(len(sweeps), dtype=bool)
        ends = np.stack([sweeps.q_start, sweeps.q_end])
        return np.asarray(((ends >= self.reach[0]) & (ends <= self.reach[1])).all(axis=(0, 2)))

    def ranges(self, cell: Cell) -> tuple[Floats, Floats]:
        """Lowest and highest value of each joint, shape (n_joints,) each."""
        if self.reach is not None:
            return np.array(self.reach[0]), np.array(self.reach[1])
        free = np.where(cell.revolute, self.free_turn, self.free_travel)
        low = np.where(np.isfinite(cell.low), cell.low, -free)
        return low, np.where(np.isfinite(cell.high), cell.high, free)


def controllers(cell: Cell) -> list[NDArray[np.int64]]:
    """Positions of the joints that move in step: of one controller, and of one group of the cell's envelope."""
    by_name: dict[str, list[int]] = {}
    for position, joint in enumerate(cell.joints):
        name = f"joint {position}" if joint.controller is None else f"controller {joint.controller.name}"
        by_name.setdefault(name, []).append(position)
    if cell.envelope is None:
        return [np.array(positions) for positions in by_name.values()]
    alone = [(i,) for i in range(len(cell.joints))]
    shared = {tuple(sorted(set(p) & set(g))) for p in by_name.values() for g in (*cell.envelope.together, *alone)}
    # Of groups that overlap only the larger counts.
    kept: list[tuple[int, ...]] = []
    for group in sorted(shared, key=lambda group: (-len(group), group)):
        if group and not set(group) & {i for other in kept for i in other}:
            kept.append(group)
    return [np.array(group) for group in sorted(kept)]


#: Shares of joints at rest that stand at the end of their range or at zero; the others stand anywhere.
_AT_END, _AT_ZERO = 0.4, 0.15
#: Share of sweeps that move several joints of one controller, and of those moves that use the whole range.
_SEVERAL, _WHOLE = 0.4, 0.6
#: Shortest move, as a share of a joint's range.
_SHORTEST = 0.1
#: Least share of a joint's range that must be visible for the joint to be moved at all.
_NARROWEST = 0.01
_ROUNDS = 60
#: Points of a sweep at which its cavity length is looked at.
_POINTS = 9
#: Steps in which the range of a joint is searched for the end of visibility.
_STEPS = 201


def candidate_sweeps(
    cell: Cell,
    *,
    n: int,
    rng: np.random.Generator,
    values: Floats | None = None,
    limits: SweepLimits | None = None,
    several: bool = True,
) -> Sweeps:
    """Random sweeps that can be measured, as a plan of `n` rows labelled ``c1`` and so on.

    Visibility and fringe rate are judged at `values` (n_free,) of the free parameters, in um and rad, by default
    nominal. With `several`, several joints of one controller also move at once. `InputError` if the limits leave no
    room for sweeps.
    """
    limits = SweepLimits() if limits is None else limits
    model = CavityModel.of(cell)
    values = cell.free.nominal if values is None else values
    ranges = visible_ranges(model, values, limits)
    starts, ends, found = [], [], 0
    for _ in range(_ROUNDS):
        start, end = _draw(cell, 2 * n, rng, ranges, several)
        good = can_be_followed(model, values, start, end, limits)
        starts.append(start[good])
        ends.append(end[good])
        found += int(good.sum())
        if found >= n:
            break
    else:
        raise InputError(
            f"cell {cell.name!r}: only {found} of {2 * n * _ROUNDS} random sweeps keep the mirror within "
            f"{np.degrees(limits.tilt):g} deg of the optical axis and below {limits.fringe_rate:g} fringes a second; "
            "expected wider limits"
        )
    labels = [f"c{i}" for i in range(1, n + 1)]
    return Sweeps.of_um_rad(np.vstack(starts)[:n], np.vstack(ends)[:n], label=labels, file="candidates")


def visible_ranges(model: CavityModel, values: Floats, limits: SweepLimits) -> tuple[Floats, Floats]:
    """Lowest and highest value of each joint (n_joints,) at which it alone keeps fringes; narrow ones stay."""
    low, high = limits.ranges(model.cell)
    home = np.clip(0.0, low, high)
    if not tilts(model, values, home[None])[0] <= limits.tilt:
        raise InputError(
            f"cell {model.cell.name!r}: the mirror stands more than {np.degrees(limits.tilt):g} deg off the optical "
            "axis with all joints at zero; expected a larger tilt limit"
        )
    share = np.linspace(0.0, 1.0, _STEPS)
    ends = []
    for bound in (low, high):
        # One joint after the other leaves home: poses of shape (n_joints, n_steps, n_joints).
        moves = np.eye(len(home))[:, None] * share[:, None] * (bound - home)
        found = tilts(model, values, (home + moves).reshape(-1, len(home))).reshape(len(home), -1)
        reached = np.logical_and.accumulate(found <= limits.tilt, axis=1).sum(axis=1) - 1
        ends.append(home + share[reached] * (bound - home))
    narrow = ends[1] - ends[0] < _NARROWEST * (high - low)
    return np.where(narrow, home, ends[0]), np.where(narrow, home, ends[1])


def tilts(model: CavityModel, values: Floats, q: Floats) -> Floats:
    """Largest angle between a mirror's normal and its light at poses (n, n_joints), in rad, shape (n,)."""
    if model.cell.further or model.cell.target != "plane-mirror":
        mirrors = [(view, own) for view, own in model.views if view.cell.target == "plane-mirror"]
        return np.max([np.zeros(len(q)), *(tilts(view, values[own], q) for view, own in mirrors)], axis=0)
    normals, _ = model.mirrors(values, q)
    axis = np.asarray(chain.optical_axis(model.cell, model.vector(values)), dtype=float)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(normals, axis), axis=1), np.abs(normals @ axis)))


def can_be_followed(model: CavityModel, values: Floats, start: Floats, end: Floats, limits: SweepLimits) -> Bools:
    """Whether fringes stay visible and countable on the way from `start` to `end`, each (n, n_joints); shape (n,)."""
    cell = model.cell
    q = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, _POINTS)[:, None]
    flat = q.reshape(-1, q.shape[-1])
    good: Bools = (tilts(model, values, flat) <= limits.tilt).reshape(len(start), -1).all(axis=1)
    for view, own in model.views:
        lengths = view.predict(values[own], view.pose_rows(flat)).reshape(len(start), -1)
        fringes = np.abs(np.diff(lengths, axis=1)).max(axis=1) * (_POINTS - 1) / (view.cell.wavelength / 2.0)
        good &= fringes <= limits.fringe_rate * travel_seconds(cell, end - start)
        good &= (lengths > 0).all(axis=1) | (view.cell.target != "plane-mirror")
    return good


def reverses(model: CavityModel, values: Floats, sweeps: Sweeps) -> Bools:
    """Whether a length turns round on the way by half a fringe, (n_draws, n_sweeps); `values` (n_draws, n_free)."""
    q = sweeps.q_start[:, None] + (sweeps.q_end - sweeps.q_start)[:, None] * np.linspace(0.0, 1.0, _POINTS)[:, None]
    many, turned = np.atleast_2d(values), []
    for view, own in model.views:
        lengths = view.predict(many[:, own], view.pose_rows(q.reshape(-1, q.shape[-1])))
        steps = np.diff(lengths.reshape(len(lengths), len(sweeps), -1), axis=-1)
        back = np.minimum(steps.clip(min=0.0).sum(axis=-1), (-steps).clip(min=0.0).sum(axis=-1))
        turned.append(back > view.cell.wavelength / 4.0)
    return np.any(turned, axis=0)


def _draw(
    cell: Cell, n: int, rng: np.random.Generator, ranges: tuple[Floats, Floats], several: bool
) -> tuple[Floats, Floats]:
    low, high = ranges
    n_joints = len(cell.joints)
    start = rng.uniform(low, high, (n, n_joints))
    where = rng.random((n, n_joints))
    start = np.where(where < _AT_END, np.where(rng.random((n, n_joints)) < 0.5, low, high), start)
    start = np.where((where >= _AT_END) & (where < _AT_END + _AT_ZERO), np.clip(0.0, low, high), start)

    moved = np.zeros((n, n_joints), dtype=bool)
    moved[np.arange(n), rng.integers(n_joints, size=n)] = True
    if several:
        together = np.zeros((n_joints, n_joints), dtype=bool)
        for group in controllers(cell):
            together[np.ix_(group, group)] = True
        moved |= (moved @ together) & (rng.random((n, n_joints)) < 0.5) & (rng.random(n) < 2.0 * _SEVERAL)[:, None]
    whole = (rng.random(n) < _WHOLE)[:, None]
    first = np.where(whole, np.where(rng.random((n, n_joints)) < 0.5, low, high), rng.uniform(low, high, (n, n_joints)))
    last = np.where(whole, low + high - first, rng.uniform(low, high, (n, n_joints)))
    start, end = np.where(moved, first, start), np.where(moved, last, start)
    enough = long_enough(end - start, high - low)
    return start[enough], end[enough]


def long_enough(moves: Floats, widths: Floats) -> Bools:
    """Whether one joint at least uses a fair part of its range; joints that cannot move do not count."""
    return (np.abs(moves) / np.where(widths > 0, widths, np.inf)).max(axis=1) >= _SHORTEST
