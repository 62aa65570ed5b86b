"""Compiled kernels: joint values at which the tool frame takes a given pose, for many vectors and poses at once.

Chains of three revolute and three prismatic joints are solved in closed form; Newton only removes what rounding leaves.
Other chains are solved by damped Newton steps from several starts.

Prismatic joints never turn anything, so the three turns alone give the orientation. With the target's orientation
M = Rz(p1) A2 Rz(p2) A3 Rz(p3), A2 and A3 being constant rotations of the chain,

    M[2, 2] = P cos p2 + Q sin p2 + K

has two solutions p2 (the generalised Euler angles of Davenport, see Wittenburg and Lilov, Multibody System Dynamics 9,
2003), p1 and p3 follow from the third column and the third row of M, and the position is linear in the prismatic
joints.
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.lengths import ALPHA, BETA, GAIN, STRIDE, THETA, D, R, Turned, start_block
from fpcal_bayes.model.kernels.pose import Work, newton, pose_error, pose_jacobian

#: What became of a pose.
OK, OUT_OF_REACH, SATURATED, SINGULAR = range(4)

#: Below this determinant of the scaled Jacobian the joints are not determined by the pose.
SINGULAR_BELOW = 1e-6
_TURN = 2.0 * math.pi
#: Which joints turn, and their lower and upper limits, (n_joints,) each.
Limits = tuple[Bools, Floats, Floats]
#: How far |cos p2| may pass 1 by rounding.
_COSINE_SLACK = 1e-9


@compiled
def constant_rotations(cosine: Floats, sine: Floats, revolute: Bools, between: Floats) -> None:
    """Rotations before, between and behind the revolute joints; writes `between` (n_revolute + 1, 3, 3)."""
    part, x = 0, between[0]
    x[:] = np.eye(3)
    for link in range(revolute.size):
        at = STRIDE * link
        cb, sb, ca, sa = cosine[at + BETA], sine[at + BETA], cosine[at + ALPHA], sine[at + ALPHA]
        ct, st = cosine[at + THETA], sine[at + THETA]
        for i in range(3):
            first = cb * x[i, 0] - sb * x[i, 2]
            tilted = sb * x[i, 0] + cb * x[i, 2]
            second, third = ca * x[i, 1] + sa * tilted, ca * tilted - sa * x[i, 1]
            x[i, 0], x[i, 1], x[i, 2] = ct * first + st * second, ct * second - st * first, third
        if revolute[link]:
            part += 1
            x = between[part]
            x[:] = np.eye(3)


@compiled
def three_turns(between: Floats, target: Floats, turns: Floats) -> int:
    """Turns of three revolute joints that give the orientation of `target`, wTe; `between` by `constant_rotations`.

    Writes `turns` (2, 3), in rad, equal where the two solutions meet. Returns 2, or 0 if it is out of reach.
    """
    m, half_way = np.empty((3, 3)), np.empty((3, 3))
    first, last = between[0], between[3]
    for i in range(3):
        for j in range(3):
            half_way[i, j] = first[0, i] * target[0, j] + first[1, i] * target[1, j] + first[2, i] * target[2, j]
    for i in range(3):
        for j in range(3):
            m[i, j] = half_way[i, 0] * last[j, 0] + half_way[i, 1] * last[j, 1] + half_way[i, 2] * last[j, 2]
    a, b = between[1], between[2]
    p = a[2, 0] * b[0, 2] + a[2, 1] * b[1, 2]
    q = a[2, 1] * b[0, 2] - a[2, 0] * b[1, 2]
    wanted, size = m[2, 2] - a[2, 2] * b[2, 2], math.hypot(p, q)
    if not abs(wanted) <= size + _COSINE_SLACK:
        return 0
    ratio = max(-1.0, min(1.0, wanted / size)) if size > 0.0 else 1.0
    middle, half = math.atan2(q, p), math.acos(ratio)
    product = np.empty((3, 3))
    for branch in range(2):
        turn = middle + (half if branch == 0 else -half)
        c, s = math.cos(turn), math.sin(turn)
        for i in range(3):
            x, y = a[i, 0] * c + a[i, 1] * s, a[i, 1] * c - a[i, 0] * s
            for j in range(3):
                product[i, j] = x * b[0, j] + y * b[1, j] + a[i, 2] * b[2, j]
        turns[branch, 0] = math.atan2(m[1, 2], m[0, 2]) - math.atan2(product[1, 2], product[0, 2])
        turns[branch, 1] = turn
        turns[branch, 2] = math.atan2(product[2, 1], product[2, 0]) - math.atan2(m[2, 1], m[2, 0])
    return 2


@compiled
def wind(q: float, period: float, near: float, low: float, high: float) -> float:
    """The joint value whole periods from `q` that lies nearest to `near`, inside the limits if one does."""
    slack = 1e-9 * (1.0 + abs(q))
    q += period * math.floor((near - q) / period + 0.5)
    if q < low - slack:
        inside = q + period * math.ceil((low - slack - q) / period)
        return inside if inside <= high + slack else q
    if q > high + slack:
        inside = q - period * math.ceil((q - high - slack) / period)
        return inside if inside >= low - slack else q
    return q


@compiled
def nearest_first(vector: Floats, revolute: Bools, low: Floats, high: Floats, near: Floats, turns: Floats) -> None:
    """Make joint values of the two solutions `turns` (2, 3), wound towards `near`, and order them by their distance."""
    far = np.zeros(2)
    for branch in range(2):
        which = 0
        for link in range(revolute.size):
            if revolute[link]:
                scale = 1.0 + vector[STRIDE * link + GAIN]
                turns[branch, which] = wind(
                    turns[branch, which] / scale, _TURN / abs(scale), near[link], low[link], high[link]
                )
                far[branch] += (turns[branch, which] - near[link]) ** 2
                which += 1
    if far[1] < far[0]:
        for which in range(3):
            turns[0, which], turns[1, which] = turns[1, which], turns[0, which]


@compiled
def place_prismatic(vector: Floats, revolute: Bools, axes: Floats, error: Floats, q: Floats) -> float:
    """Move three prismatic joints, standing at `q`, by the position error; returns the determinant of their axes."""
    used, a, cross, right = 0, np.empty((3, 3)), np.empty((3, 3)), np.zeros(3)
    for link in range(revolute.size):
        if not revolute[link]:
            for i in range(3):
                a[used, i] = axes[link, 2, i] * (1.0 + vector[STRIDE * link + GAIN])
            used += 1
    for row in range(3):
        b, c = (row + 1) % 3, (row + 2) % 3
        for i in range(3):
            one, two = (i + 1) % 3, (i + 2) % 3
            cross[row, i] = a[b, one] * a[c, two] - a[b, two] * a[c, one]
            right[row] += cross[row, i] * error[i]
    volume = a[0, 0] * cross[0, 0] + a[0, 1] * cross[0, 1] + a[0, 2] * cross[0, 2]
    used = 0
    for link in range(revolute.size):
        if not revolute[link]:
            if abs(volume) > 1e-12:
                q[link] += right[used] / volume
            used += 1
    product: float = volume
    return product


@compiled
def axes_volume(revolute: Bools, axes: Floats) -> float:
    """Determinant of the directions of the first three revolute axes; `axes` as by `chain_axes`."""
    used, matrix = 0, np.empty((3, 3))
    for link in range(revolute.size):
        if revolute[link] and used < 3:
            matrix[used] = axes[link, 2]
            used += 1
    a, b, c = matrix[0], matrix[1], matrix[2]
    volume: float = a[0] * (b[1] * c[2] - b[2] * c[1])
    volume += a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    return volume


@compiled
def worst_joint(revolute: Bools, low: Floats, high: Floats, q: Floats) -> int:
    """The joint that is farthest outside its limits (turns in rad beside lengths in mm), or -1 if none is."""
    worst, most = -1, 0.0
    for i in range(q.size):
        excess = max(low[i] - q[i], q[i] - high[i]) - 1e-9 * (1.0 + abs(q[i]))
        excess *= 1.0 if revolute[i] else 1e-3
        if excess > most:
            worst, most = i, excess
    return worst


@compiled
def distance(revolute: Bools, q: Floats, near: Floats) -> float:
    """Square of the distance of two joint vectors, turns in rad beside lengths in mm."""
    total = 0.0
    for i in range(q.size):
        total += ((q[i] - near[i]) * (1.0 if revolute[i] else 1e-3)) ** 2
    return total


@compiled
def reach_of(vector: Floats, n_links: int) -> float:
    """A length of the chain, in um, by which positions and turns are weighed against each other."""
    length = 1.0
    for link in range(n_links):
        length += abs(vector[STRIDE * link + D]) + abs(vector[STRIDE * link + R])
    return length


@compiled
def solve_pose(
    chain: Turned,
    limits: Limits,
    between: Floats,
    target: Floats,
    near: Floats,
    starts: Floats,
    branch: int,
    work: Work,
) -> tuple[int, int, Floats]:
    """Joint values of one pose: the solution nearest to `near`, inside the limits if one is.

    between: from `constant_rotations`; used where three joints turn.
    starts: where Newton begins if the chain has no closed form, after `near`, shape (n_starts, n_joints).
    branch: 0 or 1: that solution of the closed form, or that start, only; -1: all.
    Returns status, the joint that is saturated or -1, and the joint values, NaN if the pose is out of reach.
    """
    vector, _, _ = chain
    revolute, low, high = limits
    _, _, frame, axes = work
    n = revolute.size
    closed = np.count_nonzero(revolute) == 3
    length = reach_of(vector, n)
    q, error, jacobian, turns, best = np.empty(n), np.empty(6), np.empty((6, n)), np.empty((2, 3)), np.full(n, np.nan)
    status, joint, least = OUT_OF_REACH, -1, np.inf
    attempts = three_turns(between, target, turns) if closed else 1 + starts.shape[0]
    if closed and attempts == 2:
        nearest_first(vector, revolute, low, high, near, turns)
    for attempt in range(attempts):
        if branch not in (-1, attempt):
            continue
        volume = 1.0
        if closed:
            which = 0
            for link in range(n):
                q[link] = 0.0
                if revolute[link]:
                    q[link] = turns[attempt, which]
                    which += 1
            pose_error(chain, revolute, q, target, work, error)
            volume = place_prismatic(vector, revolute, axes, error, q)
        else:
            q[:] = near if attempt == 0 else starts[attempt - 1]
        met = newton(chain, revolute, length, target, q, work, error)
        if closed:
            singular = abs(volume) < SINGULAR_BELOW or abs(axes_volume(revolute, axes)) < SINGULAR_BELOW
        elif not met:
            continue
        else:
            for link in range(n):
                if revolute[link]:
                    period = _TURN / abs(1.0 + vector[STRIDE * link + GAIN])
                    q[link] = wind(q[link], period, near[link], low[link], high[link])
            pose_jacobian(vector, revolute, q, frame, axes, jacobian)
            for j in range(n):
                for i in range(3):
                    jacobian[i, j] /= length if revolute[j] else 1.0
            singular = abs(float(np.linalg.det(jacobian))) < SINGULAR_BELOW
        if not met and not singular:
            continue
        outside = worst_joint(revolute, low, high, q)
        far = distance(revolute, q, near)
        found = SINGULAR if singular else (SATURATED if outside >= 0 else OK)
        # A solution that can be driven to comes first; of several, the nearest.
        rank = (0.0 if found == OK else 1e6 if found == SATURATED else 1e12) + far
        if rank < least:
            least, status, joint = rank, found, outside if found == SATURATED else -1
            best[:] = q
        if found == OK:
            break
    return status, joint, best


@compiled
def batch_inverse(
    vectors: Floats, limits: Limits, targets: Floats, near: Floats, follow: bool, starts: Floats, branch: int
) -> tuple[Floats, Ints, Ints]:
    """Joint values (n_vectors, n_poses, n_joints) of many tool poses, status and saturated joint, (n_vectors, n_poses).

    targets: wTe, shape (n_vectors, n_poses, 4, 4), or (1, n_poses, 4, 4) for all vectors.
    follow: whether each pose is looked for near the one before it instead of `near`; the others as in `solve_pose`.
    """
    revolute, _, _ = limits
    n, n_vectors, n_poses = revolute.size, vectors.shape[0], targets.shape[1]
    q = np.empty((n_vectors, n_poses, n))
    status, joint = np.empty((n_vectors, n_poses), dtype=np.int64), np.empty((n_vectors, n_poses), dtype=np.int64)
    work = np.empty(n), np.empty(n), np.empty((4, 3)), np.empty((n + 1, 5, 3))
    between = np.empty((np.count_nonzero(revolute) + 1, 3, 3))
    last = near.copy()
    for k in range(n_vectors):
        _, block_cosine, block_sine = start_block(vectors[k], n, 1, 1)
        chain = vectors[k], block_cosine[:, 0].copy(), block_sine[:, 0].copy()
        constant_rotations(chain[1], chain[2], revolute, between)
        last[:] = near
        for m in range(n_poses):
            target = targets[k if targets.shape[0] > 1 else 0, m]
            found = solve_pose(chain, limits, between, target, last, starts, branch, work)
            status[k, m], joint[k, m], q[k, m] = found
            if follow and status[k, m] != OUT_OF_REACH:
                last[:] = q[k, m]
    return q, status, joint
