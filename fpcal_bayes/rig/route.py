"""Where the joints go: what forbids a move, and what a dry run tells of it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.ticket import Order
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import breaches
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.joint_path import JointPath, box
from fpcal_bayes.model.margin import estimate_draws, prior_draws, require_envelope
from fpcal_bayes.rig.settings import Rig

#: Points of a straight line on which gap and length are looked at, and those that are held to the cell's envelope.
_POINTS, _LINE = 33, 9
#: Points per moving joint of the box through which joints that are not in step may pass.
_BOX = 3


class CellEnvelope:
    """What keeps the mirror off the fibre, with what an estimate, or else the cell's prior, knows of it."""

    def __init__(self, cell: Cell, estimate: Estimate | None = None) -> None:
        self.together = require_envelope(cell).together
        self._model, self._draws = prior_draws(cell) if estimate is None else estimate_draws(estimate)

    def refusals(self, moves: Sequence[Sequence[Floats]], speed: Floats) -> list[str | None]:
        """Why each move, of poses at its start, stops and end, may leave the envelope in whatever order of joints."""
        share = np.linspace(0.0, 1.0, _LINE)[:, None]
        poses, rows, steps, seconds, count = [], [], [], [], 0
        for row, stops in enumerate(moves):
            for start, end in pairwise(stops):
                turn = np.vstack([start + share * (end - start), box(self._model.cell, start, end)])
                first = count + np.arange(_LINE - 1)
                steps.append(np.column_stack([first, first + 1]))
                seconds.append(np.full(_LINE - 1, (np.abs(end - start) / speed).max() / (_LINE - 1)))
                poses.append(turn)
                rows.append(np.full(len(turn), row))
                count += len(turn)
        q, row_of = np.vstack(poses), np.concatenate(rows)
        path = JointPath(q, row_of, np.zeros(len(q), dtype=bool), np.vstack(steps), np.concatenate(seconds))
        found = breaches(self._model, self._draws, path)
        return [found.get(row) for row in range(len(moves))]


class ForbiddenMoveError(InputError):
    """A move that must not be made; the message is one line and says why."""


@dataclass(frozen=True)
class Leg:
    """One move and the reading after it."""

    name: str  # what it is for
    start: Floats  # joint vector in um and rad
    end: Floats  # likewise
    seconds: float  # that it takes, with settling
    gap: float  # least distance of fibre and mirror on the way, in um
    fringe_rate: float  # most fringes per second


class Guard:
    """Looks at every move before it is made, by an estimate's geometry or the nominal one, and the cell's envelope."""

    def __init__(
        self, cell: Cell, rig: Rig, estimate: Estimate | None = None, envelope: CellEnvelope | None = None
    ) -> None:
        self._cell = cell
        self._rig = rig
        self._envelope = CellEnvelope(cell, estimate) if envelope is None and cell.envelope is not None else envelope
        parameters = cell.free if estimate is None else estimate.parameters
        self._values = parameters.nominal if estimate is None else estimate.values
        self._model = CavityModel.of(cell, parameters)
        # Moves, either way, that were found to be allowed.
        self._allowed: set[frozenset[bytes]] = set()
        sizes = () if cell.mechanics is None else cell.mechanics.joints
        self._reverses = np.array([joint.reversal > 0.0 for joint in sizes] or [False] * len(cell.joints), dtype=bool)
        self.tolerance = np.array([joint.tolerance for joint in rig.joints])
        self.speed = np.array([joint.speed for joint in rig.joints])

    def inside(self, q: Floats) -> Floats:
        """The pose that is commanded for `q`: at a limit, one tolerance inside it, where it is sure to be reached."""
        return np.clip(q, self._cell.low + self.tolerance, self._cell.high - self.tolerance)

    def check_pose(self, q: Floats, what: str) -> None:
        """Raise `ForbiddenMoveError` where a joint is out of its limits by more than its tolerance."""
        outside = ~((q >= self._cell.low - self.tolerance) & (q <= self._cell.high + self.tolerance))
        if outside.any():
            i = int(np.argmax(outside))
            joint, scale = self._cell.joints[i], self._cell.joint_scales[i]
            raise ForbiddenMoveError(
                f"{what}: q{i + 1} = {q[i] / scale:g} {joint.unit} is outside the limits of cell {self._cell.name!r}, "
                f"{joint.low / scale:g} to {joint.high / scale:g} {joint.unit}"
            )

    def check_move(self, start: Floats, end: Floats, what: str) -> None:
        """Raise `ForbiddenMoveError` unless all poses between two are allowed: axes do not move in step."""
        self.check_moves([(start, end, what)])

    def check_moves(self, moves: Sequence[tuple[Floats, Floats, str]]) -> None:
        """`check_move` for several, of which many are alike."""
        new: dict[frozenset[bytes], tuple[Floats, Floats, str]] = {}
        for start, end, what in moves:
            self.check_pose(start, what)
            self.check_pose(end, what)
            key = frozenset((start.tobytes(), end.tobytes()))
            if key not in self._allowed:
                new.setdefault(key, (start, end, what))
        if self._rig.least_gap > 0.0:
            for start, end, what in new.values():
                gap = float(self.gaps(_box(start, end)).min())
                if gap < self._rig.least_gap:
                    raise ForbiddenMoveError(
                        f"{what}: the mirror comes as near to the fibre as {gap:.1f} um, "
                        f"expected {self._rig.least_gap:g} um or more"
                    )
        if self._envelope is not None and new:
            stops = [[start, *self.turns(start, end)] for start, end, _ in new.values()]
            for (_, _, what), refusal in zip(new.values(), self._envelope.refusals(stops, self.speed), strict=True):
                if refusal:
                    raise ForbiddenMoveError(f"{what}: {refusal}")
        self._allowed |= set(new)

    def gaps(self, q: Floats) -> Floats:
        """Distance from the fibre's end to the mirror's plane at poses (n, n_joints), in um."""
        normals, origins = self._model.mirrors(self._values, q)
        fibre = chain.fibre_in_world(self._model.vector(self._values))[:3, 3]
        distance: Floats = np.abs(np.sum(normals * (origins - fibre), axis=1))
        return distance

    def turns(self, start: Floats, end: Floats) -> list[Floats]:
        """The poses at which a move stops on its way: joints that must not move at once go one after the other."""
        moving = np.flatnonzero(start != end).tolist()
        groups = [range(len(start))] if self._envelope is None else self._envelope.together
        parts = [[joint for joint in moving if joint in group] for group in groups]
        single = [[joint] for joint in moving if not any(joint in group for group in groups)]
        poses = [start]
        for part in filter(None, [*parts, *single]):
            poses.append(poses[-1].copy())
            poses[-1][part] = end[part]
        return poses[1:] or [end]

    def seconds(self, start: Floats, end: Floats) -> float:
        """Time of a move, with settling."""
        return sum(self._turn_seconds(*turn) for turn in pairwise([start, *self.turns(start, end)]))

    def _turn_seconds(self, start: Floats, end: Floats) -> float:
        moving = start != end
        if not moving.any():
            return 0.0
        rest = [joint.settle_s for joint, moves in zip(self._rig.joints, moving, strict=True) if moves]
        return float((np.abs(end - start) / self.speed).max()) + max(rest)

    def leg(self, name: str, start: Floats, end: Floats) -> Leg:
        """A move as a dry run shows it; joints are taken to arrive together."""
        line = start + (end - start) * np.linspace(0.0, 1.0, _POINTS)[:, None]
        lengths = self._model.predict(self._values, self._model.pose_rows(line))
        motion = float((np.abs(end - start) / self.speed).max())
        change = float(np.abs(np.diff(lengths)).max()) * (_POINTS - 1)
        rate = change / motion / (self._cell.wavelength / 2.0) if motion > 0.0 else 0.0
        gap = float(self.gaps(np.concatenate([line, _box(start, end)])).min())
        return Leg(name, start, end, self.seconds(start, end), gap, rate)

    def moves(self, order: Order, at: Floats, before: Order | None = None) -> list[tuple[Floats, Floats, str]]:
        """The moves of an order from where the joints stand, after the order `before` if any: start, end, what for."""
        stops = [at, *self.run_up(order, before), *self.stops(order)]
        names = ["to the start"] * (len(stops) - len(order.labels) - 2) + [*order.labels, "back to the start"]
        return [
            (start, end, f"row {order.row}: {order.label!r}, {name}")
            for name, (start, end) in zip(names, pairwise(stops), strict=True)
        ]

    def run_up(self, order: Order, before: Order | None, *, returned: bool = True) -> list[Floats]:
        """The pose on the way to an order's start from which the start is reached as the order of the rows says.

        Rows say that a joint comes from where the last kept sweep ended; it has `returned` to that sweep's start since,
        or else stands anywhere. That matters where the cell states its reversal.
        """
        start = self.inside(order.start)
        if before is None:
            return []
        first, last = self.inside(before.start), self.inside(before.targets[-1])
        other = (start - first) * (start - last) < 0 if returned else start != last
        other &= self._reverses
        return [np.where(other, last, start)] if other.any() else []

    def stops(self, order: Order) -> Iterator[Floats]:
        """The poses at which an order stops: its start, its targets, its start."""
        yield self.inside(order.start)
        for target in order.targets:
            yield self.inside(target)
        yield self.inside(order.start)


def dry_run(guard: Guard, orders: Sequence[Order], at: Floats) -> list[list[Leg]]:
    """Every move of every order, looked at and timed, none made; `ForbiddenMoveError` at the first forbidden one."""
    moves: list[list[tuple[Floats, Floats, str]]] = []
    for before, order in zip([None, *orders], orders, strict=False):
        moves.append(guard.moves(order, at, before))
        at = moves[-1][-1][1]
    guard.check_moves([move for each in moves for move in each])
    return [[guard.leg(what, start, end) for start, end, what in each] for each in moves]


def total_seconds(legs: Iterable[Iterable[Leg]]) -> float:
    """Time of all moves."""
    return sum(leg.seconds for order in legs for leg in order)


def _box(start: Floats, end: Floats) -> Floats:
    """A grid over all poses whose joints each lie between start and end."""
    moving = np.flatnonzero(start != end)
    shares = np.array(list(product(np.linspace(0.0, 1.0, _BOX), repeat=len(moving))))
    poses = np.tile(start, (len(shares), 1))
    poses[:, moving] += (end - start)[moving] * shares
    return poses
