"""Design matrices: what each weight of the mechanics adds to rows of a file, and to the points of a task's path."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.mechanics.drive import Drive, sides_after
from fpcal_bayes.model.mechanics.response import ACROSS, UP, Responses, pose_responses, responses
from fpcal_bayes.model.mechanics.terms import DRIFT_ORDER, HARMONICS, LEGENDRE, Terms, group_of, harmonics, polynomials

#: Slow reading errors: cosines over the order of the rows, at most so many and one per four rows.
_MOST_SLOW = 24
#: They fall beyond this share of them.
_KNEE = 0.35
#: Beginnings of the names of weights that each session has anew, and of those of sessions before the last.
_EARLIER = "earlier "
_OWN = ("drift", "slow", "wavelength", "first approach", "return of", "position of", _EARLIER)
#: Errors of positions that several rows share are weights of their own, at most so many of a kind, if they reach this
#: share of the readings' noise. The rest is new in each sweep, and in longer files than this all is.
_MOST_SHARED, _FELT, _LONG = 120, 0.02, 1000


@dataclass(frozen=True, repr=False)
class Design(Brief):
    """What weights of unit prior variance add to rows, to first order."""

    matrix: Floats  # in um, shape (n_rows, n_weights)
    names: tuple[str, ...]  # of the weights' terms, n_weights of them
    scale: Ints  # position of each weight's scale in `Terms.scales`, shape (n_weights,)
    # what the return errors of joints that stand still in a row do to it: change of the response between its ends times
    # the return's sd, shape (n_rows, n_joints)
    returned: Floats
    reached_start: Floats  # the same of joints that are reached anew at an end, shape (n_rows, n_joints)
    reached_end: Floats  # likewise

    @cached_property
    def motion_count(self) -> int:
        """Number of leading weights that a task shares (error motions, reversal, encoders)."""
        return sum(not name.startswith(_OWN) for name in self.names)


@dataclass(frozen=True)
class PathDesign:
    """What the same weights add to L(q) - L(q0) along a path."""

    motions: Floats  # of the shared weights, shape (n_points, motion_count)
    scale: Ints  # position of each weight's scale in `Terms.scales`, shape (motion_count,)
    # of a sign per joint: the direction from which the start was reached, shape (n_points, n_joints)
    unknown_side: Floats
    drift: Floats  # of the drift's polynomials: change per um of fibre displacement in x, y, z, shape (n_points, 3)
    returned_start: Floats  # of standard normal return errors at the start, shape (n_points, n_joints)
    returned_point: Floats  # likewise at each point
    encoded: Floats  # the same of encoders of unknown period, the start first, shape (n_points + 1, n_joints)
    poses: Floats  # joint vectors, the start first, shape (n_points + 1, n_joints)
    drive: Floats  # of the joints' own travel at these poses, same shape
    # joints that stand still between one point and the next keep their return error, shape (n_points, n_joints): number
    # of the position that each joint has reached
    steps: Ints

    @cached_property
    def places(self) -> Ints:
        """Number of each joint's position, the same wherever it is the same, shape (n_points + 1, n_joints)."""
        return np.column_stack([np.unique(values, return_inverse=True)[1] for values in self.poses.T])


def _columns(terms: Terms, q: Floats, at: Responses) -> Floats:
    """Columns of the error motions at poses: value of each basis function times its response, per weight."""
    cell, joint, direction, place, sd = terms.cell, *terms.weights
    endless = np.array([group_of(cell, i) == "rotary" for i in range(len(cell.joints))], dtype=bool)
    basis = np.zeros((*q.shape, max(LEGENDRE, 2 * HARMONICS)))
    basis[:, ~endless, :LEGENDRE] = polynomials(q[:, ~endless], cell.low[~endless], cell.high[~endless])
    basis[:, endless] = harmonics(q[:, endless])
    return basis[:, joint, place] * at.motion[:, joint, direction] * sd


def _elliptic(terms: Terms, q: Floats, at: Responses) -> list[Floats]:
    """Of endless joints: the part of the fundamental radial motion that runs against the turn, (n, 2) each."""
    made = []
    for motion in terms.elliptic:
        # The second harmonic stands at half the fundamental's size.
        i, sd = motion.joint, 2.0 * motion.sd[2]
        up, across = at.motion[:, i, UP], at.motion[:, i, ACROSS]
        c, s = np.cos(q[:, i]), np.sin(q[:, i])
        made.append(sd * np.column_stack([c * up - s * across, s * up + c * across]))
    return made


def at_poses(terms: Terms, q: Floats, at: Responses) -> Floats:
    """Columns that depend on the pose alone: error motions and encoders of known period."""
    parts = [_columns(terms, q, at), *_elliptic(terms, q, at)]
    for i in terms.known_encoders:
        phase = 2.0 * np.pi * q[:, i] / terms.encoder_period[i]
        size = at.drive[:, i] * terms.encoder[i] / np.sqrt(2.0)
        parts.append(size[:, None] * np.column_stack([np.cos(phase), np.sin(phase)]))
    return np.hstack(parts)


def _names(terms: Terms) -> tuple[list[str], list[int]]:
    index = {name: i for i, name in enumerate(terms.scales)}
    each = [(motion.name, motion.scale) for motion in terms.motions for _ in range(int((motion.sd > 0).sum()))]
    each += [(f"radial runout of q{m.joint + 1}, against the turn", m.scale) for m in terms.elliptic for _ in "cs"]
    each += [(f"encoder period of q{i + 1}", "encoder") for i in terms.known_encoders for _ in "cs"]
    return [name for name, _ in each], [index[scale] for _, scale in each]


def weight_rows(terms: Terms) -> list[tuple[int, int, int, float]]:
    """What each weight that a task shares stands for, in their order: joint, kind, order, size in um or rad.

    Kinds are 1 to 6, directions of `Responses.motion`; 7, radial against the turn; 8, encoder of known period; 9,
    reversal. Orders are those of Legendre polynomials, or of harmonics, a sine's negative.
    """
    rows: list[tuple[int, int, int, float]] = []
    for motion in terms.motions:
        count = len(motion.sd)
        waves = [sign * (k + 1) for k in range(count // 2) for sign in (1, -1)]
        orders = waves if group_of(terms.cell, motion.joint) == "rotary" else range(1, count + 1)
        kinds = zip(orders, motion.sd.tolist(), strict=True)
        rows += [(motion.joint, motion.direction + 1, order, sd) for order, sd in kinds if sd > 0]
    rows += [(motion.joint, 7, sign, 2.0 * float(motion.sd[2])) for motion in terms.elliptic for sign in (1, -1)]
    rows += [(i, 8, sign, float(terms.encoder[i] / np.sqrt(2.0))) for i in terms.known_encoders for sign in (1, -1)]
    return rows + [(i, 9, 0, float(terms.reversal[i])) for i in np.flatnonzero(terms.reversal > 0).tolist()]


def design(terms: Terms, vector: Floats, drive: Drive, sigma: Floats) -> Design:
    """The design matrix of rows; sessions share the weights that a task shares, and each has its own others."""
    chosen = [drive.session == i for i in range(int(drive.session.max(initial=0)) + 1)]
    parts = [_of_session(terms, vector, drive.take(mine), sigma[mine]) for mine in chosen]
    if len(parts) == 1:
        return parts[0]
    back, shared = np.argsort(np.concatenate([np.flatnonzero(mine) for mine in chosen])), parts[-1].motion_count
    own = linalg.block_diag(*(part.matrix[:, shared:] for part in parts))
    matrix = np.hstack([np.vstack([part.matrix[:, :shared] for part in parts]), own])
    # A task is driven after the last session, and shares nothing with what passed in those before.
    before = [_EARLIER + name for part in parts[:-1] for name in part.names[shared:]]
    return Design(
        matrix[back],
        (*parts[-1].names[:shared], *before, *parts[-1].names[shared:]),
        np.concatenate([parts[-1].scale[:shared], *(part.scale[shared:] for part in parts)]),
        *(np.vstack([getattr(p, name) for p in parts])[back] for name in ("returned", "reached_start", "reached_end")),
    )


def _of_session(terms: Terms, vector: Floats, drive: Drive, sigma: Floats) -> Design:
    cell, index = terms.cell, {name: i for i, name in enumerate(terms.scales)}
    beam = cell.beam_numbers(drive.beam)
    end = responses(cell, vector, terms.told, drive.q_end, beam)
    start = responses(cell, vector, terms.told, drive.q_start, beam)
    begun = (~drive.absolute).astype(float)[:, None]
    names, scales = _names(terms)
    parts = [at_poses(terms, drive.q_end, end) - begun * at_poses(terms, drive.q_start, start)]

    reversing = np.flatnonzero(terms.reversal > 0)
    if len(reversing):
        size = terms.reversal[reversing]
        ends, starts = end.drive[:, reversing] * size, begun * start.drive[:, reversing] * size
        side_end, side_start = drive.end_side[:, reversing], drive.start_side[:, reversing]
        parts.append(ends * side_end - starts * side_start)
        names += [f"reversal of q{i + 1}" for i in reversing]
        parts.append(ends * (side_end == 0) - starts * (side_start == 0))
        names += [f"first approach of q{i + 1}" for i in reversing]
        scales += [index["approach"]] * (2 * len(reversing))

    drifting, drift_names = _drift(terms, drive, start, end, begun)
    for number in range(len(cell.beams)):
        # Each beam starts from a mount of its own, and is read by itself.
        seen = beam == number
        of = f" of beam {cell.beams[number]}" if number else ""
        parts.append(drifting * seen[:, None])
        names += [f"drift{of}{name.removeprefix('drift')}" for name in drift_names]
        scales += [index["drift"]] * drifting.shape[1]
        errors = _slow(terms, int(seen.sum()), sigma[seen])
        slow = np.zeros((len(drive), errors.shape[1]))
        slow[seen] = errors
        parts.append(slow)
        names += ["slow reading error"] * slow.shape[1]
        scales += [index["slow noise"]] * slow.shape[1]
    if drive.scaled.any():
        parts.append(drive.scaled[:, None])
        names += ["wavelength"]
        scales += [index["noise"]]

    travel = np.stack([-begun * start.drive, end.drive])
    values = np.stack([drive.q_start, drive.q_end])
    places = np.stack([np.unique(each, return_inverse=True)[1].reshape(each.shape) for each in values.T], axis=-1)
    encoded, left = _shared(travel * _unknown_encoder(terms), places.transpose(1, 0, 2), np.arange(len(drive)), sigma)
    # An encoder's error at a position that no other row has counts as return.
    effects = np.copysign(np.hypot(travel * terms.return_sd, left), travel)
    returned, (starts, ends) = _shared(effects, np.stack([drive.start_reach, drive.end_reach]), drive.sweep, sigma)
    for word, kind, found in (("position of", "encoder", encoded), ("return of", "return", returned)):
        parts += [column[:, None] for _, column in found]
        names += [f"{word} q{joint + 1}" for joint, _ in found]
        scales += [index[kind]] * len(found)
    moved = drive.moved
    # The weights that a task shares stand in front.
    order = np.argsort(np.array([name.startswith(_OWN) for name in names], dtype=bool), kind="stable")
    return Design(
        matrix=np.ascontiguousarray(np.hstack(parts)[:, order]),
        names=tuple(names[i] for i in order),
        scale=np.array(scales, dtype=np.int64)[order],
        returned=np.where(moved, 0.0, ends + starts),
        reached_start=np.where(moved, starts, 0.0),
        reached_end=np.where(moved, ends, 0.0),
    )


def _unknown_encoder(terms: Terms) -> Floats:
    """Error of each encoder whose period is not known, at any position, one sd in um or rad, shape (n_joints,)."""
    return np.where(np.isfinite(terms.encoder_period), 0.0, terms.encoder / np.sqrt(2.0))


def _shared(effects: Floats, places: Ints, users: Ints, sigma: Floats) -> tuple[list[tuple[int, Floats]], Floats]:
    """Errors of `places` that several `users`, one per row, share: joint and column of each, and the rest."""
    left, found = effects.copy(), []
    least = _FELT * float(np.median(sigma)) if 0 < len(sigma) <= _LONG else np.inf
    for i in np.flatnonzero(np.abs(effects).max(axis=(0, 1), initial=0.0) > least).tolist():
        effect, place = effects[:, :, i], places[:, :, i]
        pairs = np.unique(np.stack([place.ravel(), np.tile(users, 2)])[:, effect.ravel() != 0], axis=1)
        numbers, counts = np.unique(pairs[0], return_counts=True)
        for number in numbers[counts > 1]:
            column = (effect * (place == number)).sum(axis=0)
            found.append((float(np.abs(column).max()), i, int(number), column))
    found = sorted((each for each in found if each[0] > least), key=lambda each: -each[0])[:_MOST_SHARED]
    for _, i, number, _ in found:
        left[:, :, i][places[:, :, i] == number] = 0.0
    return [(i, column) for _, i, _, column in found], left


def _drift(terms: Terms, drive: Drive, start: Responses, end: Responses, begun: Floats) -> tuple[Floats, list[str]]:
    """Fibre displacements that are polynomials in time, and what an unknown length of a sweep adds along the beam."""
    rate = terms.sizes.drift_nm_per_min * 1e-3
    if not rate > 0 or not len(drive):
        return np.zeros((len(drive), 0)), []
    last = max(float(drive.end_min.max()), 1e-9)
    parts, names = [], []
    for order, sd in enumerate(drift_sd(terms, last), 1):
        late, early = (2.0 * minutes / last - 1.0 for minutes in (drive.end_min, drive.start_min))
        late, early = (x if order == 1 else 1.5 * x**2 - 0.5 for x in (late, early))
        parts.append(sd * (end.fibre * late[:, None] - begun * start.fibre * early[:, None]))
        names += [f"drift along {axis}" for axis in "xyz"]
    if drive.span_min.any():
        beam = np.linalg.norm(end.fibre, axis=1)
        longest = np.where(drive.span_min > 0, drive.span_min.max(), 0.0)
        parts += [(0.5 * rate * span * beam)[:, None] for span in (drive.span_min, longest)]
        names += ["drift within a sweep", "drift between readings"]
    return np.hstack(parts), names


def drift_sd(terms: Terms, last_min: float) -> Floats:
    """Standard deviations of the drift's polynomials in um, shape (DRIFT_ORDER,)."""
    rate = terms.sizes.drift_nm_per_min * 1e-3
    return np.asarray(rate * last_min / 2.0 / 2.0 ** np.arange(DRIFT_ORDER), dtype=np.float64)


def _slow(terms: Terms, n: int, sigma: Floats) -> Floats:
    """Cosines over the order of the rows; of few rows one error that they share."""
    count = min(_MOST_SLOW, n // 4)
    stated = terms.sizes.correlated_nm
    size = 0.0 if n == 0 else 0.8 * float(np.median(sigma)) if stated is None else 1e-3 * stated
    if size == 0.0:
        return np.zeros((n, 0))
    if count == 0:
        return np.full((n, 1), size)
    k = np.arange(1, count + 1)
    weight = 1.0 / (1.0 + (k / (_KNEE * count)) ** 2)
    weight *= size / np.sqrt((weight**2).sum())
    return np.asarray(np.sqrt(2.0) * np.cos(np.pi * (np.arange(n)[:, None] + 0.5) * k / n) * weight, dtype=np.float64)


def pose_designs(terms: Terms, vector: Floats, start_q: Floats, q: Floats) -> list[PathDesign]:
    """As `path_design`, of the changes of place and direction of the mirror (see `pose_responses`)."""
    found = pose_responses(terms.cell, vector, terms.told, np.vstack([start_q, q]))
    return [_path_design(terms, start_q, q, at) for at in found]


def path_design(terms: Terms, vector: Floats, start_q: Floats, q: Floats) -> PathDesign:
    """The design matrices of a path that is driven point by point from `start_q` (n_joints,); the last is kept."""
    key = vector.tobytes(), start_q.tobytes(), q.tobytes()
    made = terms.last_path.get(key)
    if made is None:
        made = _path_design(terms, start_q, q, responses(terms.cell, vector, terms.told, np.vstack([start_q, q])))
        terms.last_path.clear()
        terms.last_path[key] = made
    return made


def _path_design(terms: Terms, start_q: Floats, q: Floats, at: Responses) -> PathDesign:
    poses = np.vstack([start_q, q])
    columns, scales = at_poses(terms, poses, at), _names(terms)[1]
    reversing = np.flatnonzero(terms.reversal > 0)
    parts = [columns[1:] - columns[:1]]
    side = sides_after(np.diff(poses, axis=0))
    drive = at.drive * terms.reversal
    if len(reversing):
        parts.append((drive[1:] * side)[:, reversing])
    scales += [terms.scales.index("approach")] * len(reversing)
    # Until a joint has moved, the side from which the start was reached counts at the point too.
    unknown = drive[1:] * (side == 0) - drive[:1]
    returned, encoded = at.drive * terms.return_sd, at.drive * _unknown_encoder(terms)
    steps = np.cumsum(np.diff(poses, axis=0) != 0, axis=0).astype(np.int64)
    motions, numbers, drift = np.hstack(parts), np.array(scales, dtype=np.int64), at.fibre[1:] - at.fibre[:1]
    begun = np.repeat(returned[:1], len(q), axis=0)
    return PathDesign(motions, numbers, unknown, drift, begun, returned[1:], encoded, poses, at.drive, steps)
