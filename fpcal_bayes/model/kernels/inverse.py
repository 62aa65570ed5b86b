"""Compiled kernels: joint values at which the tool frame takes a given pose, for many vectors and poses at once.

Chains of three revolute and three prismatic joints are solved in closed form (see `turns`); Newton only removes
what rounding leaves. Other chains are solved by damped Newton steps from several starts.
"""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.lengths import GAIN, STRIDE, D, R, start_block
from fpcal_bayes.model.kernels.pose import newton, pose_error, pose_jacobian
from fpcal_bayes.model.kernels.turns import (
    axes_volume,
    constant_rotations,
    nearest_first,
    place_prismatic,
    three_turns,
    wind,
)

#: What became of a pose.
OK, OUT_OF_REACH, SATURATED, SINGULAR = range(4)

#: Below this determinant of the scaled Jacobian the joints are not determined by the pose.
SINGULAR_BELOW = 1e-6
_TURN = 2.0 * math.pi


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
    vector: Floats,
    cosine: Floats,
    sine: Floats,
    revolute: Bools,
    low: Floats,
    high: Floats,
    between: Floats,
    target: Floats,
    near: Floats,
    starts: Floats,
    branch: int,
    joint_cos: Floats,
    joint_sin: Floats,
    frame: Floats,
    axes: Floats,
    best: Floats,
) -> tuple[int, int]:
    """Joint values of one pose: the solution nearest to `near`, inside the limits if one is.

    between: from `constant_rotations`; used where three joints turn.
    starts: where Newton begins if the chain has no closed form, after `near`, shape (n_starts, n_joints).
    branch: 0 or 1: that solution of the closed form, or that start, only; -1: all.
    best: written, shape (n_joints,), whatever the status is, NaN if the pose is out of reach.
    Returns status, and the joint that is saturated or -1.
    """
    n = revolute.size
    closed = np.count_nonzero(revolute) == 3
    length = reach_of(vector, n)
    q, error, jacobian, turns = np.empty(n), np.empty(6), np.empty((6, n)), np.empty((2, 3))
    best[:] = np.nan
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
            pose_error(vector, cosine, sine, revolute, q, target, joint_cos, joint_sin, frame, axes, error)
            volume = place_prismatic(vector, revolute, axes, error, q)
        else:
            q[:] = near if attempt == 0 else starts[attempt - 1]
        met = newton(
            vector, cosine, sine, revolute, length, target, q, joint_cos, joint_sin, frame, axes, error, jacobian
        )
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
    return status, joint


@compiled
def batch_inverse(
    vectors: Floats,
    revolute: Bools,
    low: Floats,
    high: Floats,
    targets: Floats,
    near: Floats,
    follow: bool,
    starts: Floats,
    branch: int,
) -> tuple[Floats, Ints, Ints]:
    """Joint values (n_vectors, n_poses, n_joints) of many tool poses, status and saturated joint, (n_vectors, n_poses).

    targets: wTe, shape (n_vectors, n_poses, 4, 4), or (1, n_poses, 4, 4) for all vectors.
    follow: whether each pose is looked for near the one before it instead of `near`; the others as in `solve_pose`.
    """
    n, n_vectors, n_poses = revolute.size, vectors.shape[0], targets.shape[1]
    q = np.empty((n_vectors, n_poses, n))
    status, joint = np.empty((n_vectors, n_poses), dtype=np.int64), np.empty((n_vectors, n_poses), dtype=np.int64)
    joint_cos, joint_sin = np.empty(n), np.empty(n)
    frame, axes = np.empty((4, 3)), np.empty((n + 1, 5, 3))
    between = np.empty((np.count_nonzero(revolute) + 1, 3, 3))
    last = near.copy()
    for k in range(n_vectors):
        _, block_cosine, block_sine = start_block(vectors[k], n, 1, 1)
        cosine, sine = block_cosine[:, 0].copy(), block_sine[:, 0].copy()
        constant_rotations(cosine, sine, revolute, between)
        last[:] = near
        for m in range(n_poses):
            status[k, m], joint[k, m] = solve_pose(
                vectors[k],
                cosine,
                sine,
                revolute,
                low,
                high,
                between,
                targets[k if targets.shape[0] > 1 else 0, m],
                last,
                starts,
                branch,
                joint_cos,
                joint_sin,
                frame,
                axes,
                q[k, m],
            )
            if follow and status[k, m] != OUT_OF_REACH:
                last[:] = q[k, m]
    return q, status, joint
