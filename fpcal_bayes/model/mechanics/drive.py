"""How the rows of a file were driven: from which side each pose was reached, and when."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Bools, Floats, Ints


@dataclass(frozen=True, repr=False)
class Drive(Brief):
    """Rows in the order in which they were driven; joint vectors in um and rad."""

    q_start: Floats  # shape (n, n_joints)
    q_end: Floats  # likewise
    absolute: Bools  # rows that give L(end) itself, shape (n,)
    sweep: Ints  # number of the sweep that each row belongs to: rows that share the reading at their start, shape (n,)
    start_side: Floats  # direction in which each joint reached the pose: -1, 0 (not known), +1, shape (n, n_joints)
    end_side: Floats  # likewise
    start_reach: Ints  # number of the position that each joint has, the same while it stands still, (n, n_joints)
    end_reach: Ints  # likewise
    start_min: Floats  # when the start was read, in minutes, shape (n,)
    end_min: Floats  # likewise
    # how long the sweep of each row is thought to have taken where its times are not stated, else zero, shape (n,)
    span_min: Floats
    # number of the session that each row was read in, shape (n,): each begins at minute zero, with every joint reached
    # from an unknown side
    session: Ints
    # what one standard deviation of a scale that all rows share adds to each, in um, shape (n,)
    scaled: Floats
    beam: NDArray[np.str_]  # name of the beam that read each row, or empty: the first, shape (n,)

    def __len__(self) -> int:
        return len(self.q_end)

    @property
    def moved(self) -> Bools:
        """Joints that move between start and end, shape (n, n_joints)."""
        return np.asarray((self.start_reach != self.end_reach) | self.absolute[:, None])

    @property
    def session_min(self) -> float:
        """How long the last session took, in minutes."""
        return float(self.end_min[self.session == self.session.max(initial=0)].max())

    def take(self, rows: Bools | Ints) -> "Drive":
        """The rows picked by a mask (n,) or by positions."""
        return Drive(*(getattr(self, part.name)[rows] for part in fields(self)))


def drive_of(
    q_start: Floats,
    q_end: Floats,
    *,
    absolute: Bools,
    sweep: Ints,
    time_h: Floats,
    minutes_per_sweep: float,
    t_start_h: Floats | None = None,
    t_end_h: Floats | None = None,
    approach: Floats | None = None,
    still: Floats | float = 0.0,
) -> Drive:
    """Work out directions of approach and times of one session's rows, in file order.

    `sweep` numbers rise by one; stated directions of `approach` (n, n_joints) are zero where not stated; a joint whose
    value changes by no more than `still` (n_joints,) stands: values that are read back have noise.
    """
    stated = np.zeros(q_end.shape) if approach is None else approach
    (start_side, end_side), (start_reach, end_reach) = _approaches(q_start, q_end, absolute, sweep, stated, still)
    # How far along its sweep each row ends: 1 at the sweep's last row, 1/2 at a midpoint.
    length = np.linalg.norm(q_end - q_start, axis=1)
    longest = np.zeros(int(sweep.max(initial=0)) + 1)
    np.maximum.at(longest, sweep, length)
    share = np.where(longest[sweep] > 0, length / np.where(longest[sweep] > 0, longest[sweep], 1.0), 1.0)
    fraction = np.where(absolute, 0.0, share)
    # Times that differ are those of the rows; else the sweeps are so many minutes apart.
    begun = 60.0 * (time_h - time_h[0]) if np.ptp(time_h) > 0 else minutes_per_sweep * (sweep - sweep[0])
    start, end = begun.astype(float), begun + 0.5 * minutes_per_sweep * fraction
    span = np.full(len(q_end), minutes_per_sweep) * fraction
    if t_start_h is not None and t_end_h is not None:
        known = np.isfinite(t_start_h) & np.isfinite(t_end_h)
        origin = np.nanmin(np.where(known, t_start_h, np.nan)) if known.any() else 0.0
        start = np.where(known, 60.0 * (t_start_h - origin), start)
        end = np.where(known, 60.0 * (t_end_h - origin), end)
        span = np.where(known, 0.0, span)
    session = np.zeros(len(q_end), dtype=np.int64)
    sides = (start_side, end_side, start_reach, end_reach)
    alike = np.zeros(len(q_end)), np.full(len(q_end), "")
    return Drive(q_start, q_end, absolute, sweep, *sides, start, end, span, session, *alike)


def sides_after(steps: Floats) -> Floats:
    """Directions of approach after each step (n, n_joints), zero before a joint's first: the last one not zero."""
    latest = np.where(steps != 0, np.arange(1, len(steps) + 1)[:, None], 0)
    latest = np.maximum.accumulate(latest, axis=0)
    return np.take_along_axis(np.vstack([np.zeros(steps.shape[1]), np.sign(steps)]), latest, axis=0)


def _steps(poses: Floats, still: Floats | float) -> Floats:
    """How far each joint moves to each pose, zero while it is within `still` of where it came to last."""
    steps, at = np.zeros(poses.shape), poses[0].copy()
    for step, pose in zip(steps[1:], poses[1:], strict=True):
        moved = np.abs(pose - at) > still
        step[moved] = (pose - at)[moved]
        at[moved] = pose[moved]
    return steps


def _approaches(
    q_start: Floats, q_end: Floats, absolute: Bools, sweep: Ints, stated: Floats, still: Floats | float
) -> tuple[tuple[Floats, Floats], tuple[Ints, Ints]]:
    """At start and end of each row: directions of approach, zero before a joint's first move; positions reached."""
    n, n_joints = q_end.shape
    new = np.ones(n, dtype=bool)
    new[1:] = sweep[1:] != sweep[:-1]
    starts = np.flatnonzero(new & ~absolute)
    # The poses one after the other: each sweep's start before its ends.
    place = np.arange(n) + np.cumsum(new & ~absolute)
    poses = np.empty((n + len(starts), n_joints))
    poses[place] = q_end
    start_place = place[starts] - 1
    poses[start_place] = q_start[starts]
    steps = _steps(poses, still)
    came = steps.copy()
    came[place] = np.where(stated != 0, stated, steps[place])
    sides = sides_after(came)
    reached = np.cumsum(steps != 0, axis=0)
    first = np.full(n, -1)
    first[starts] = start_place
    first = np.maximum.accumulate(first)
    start_side = np.where(first[:, None] >= 0, sides[np.maximum(first, 0)], 0.0)
    return (start_side, sides[place]), (reached[np.maximum(first, 0)], reached[place])
